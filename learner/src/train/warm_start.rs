//! The warm start: regression towards the servo action on demonstrations that actors make.

use comic_experiment::{Experiment, TaskSpec};
use comic_proto::Field;
use comic_replay::Batch;
use rand::Rng;
use rand::seq::index::sample;
use tch::Device;

use crate::algorithm::Algorithm;
use crate::algorithm::loss_report::Losses;
use crate::algorithm::minibatch::MinibatchTensors;
use crate::algorithm::minibatch::masked_to_device;
use crate::error::Result;

/// Which unrolls of a batch are demonstrations; the others are masked.
#[derive(Debug)]
struct Demonstrated {
    unrolls: Vec<usize>,
    masked: Vec<usize>,
}

impl Demonstrated {
    /// Of unrolls of these tasks.
    fn among(tasks: &[usize], demonstrated: impl Fn(usize) -> bool) -> Self {
        let (unrolls, masked) =
            (0..tasks.len()).partition(|unroll| tasks.get(*unroll).copied().is_some_and(&demonstrated));
        Self { unrolls, masked }
    }

    /// `valid`, `[B, T]`, as if every masked unroll were padding.
    fn mask(&self, valid: &[f32]) -> Vec<f32> {
        let mut valid = valid.to_vec();
        let length = valid.len() / (self.unrolls.len() + self.masked.len()).max(1);
        for unroll in &self.masked {
            valid.iter_mut().skip(unroll * length).take(length).for_each(|valid| *valid = 0.0);
        }
        valid
    }

    /// `count` different unrolls, or all of them if there are fewer: random demonstrations, then masked unrolls. The masked
    /// ones keep the size of a minibatch constant, because XLA compiles a program for every size.
    fn choose(&self, count: usize, random: &mut impl Rng) -> Vec<usize> {
        let places = sample(random, self.unrolls.len(), self.unrolls.len().min(count));
        let demonstrated = places.into_iter().filter_map(|place| self.unrolls.get(place));
        demonstrated.chain(&self.masked).copied().take(count).collect()
    }
}

/// A batch of the servo's rollouts.
#[derive(Debug)]
struct Demonstrations {
    tensors: MinibatchTensors,
    demonstrated: Demonstrated,
}

/// The demonstrations gathered so far, and the regression on them.
#[derive(Debug)]
pub(super) struct WarmStart {
    batches: Vec<Demonstrations>,
    /// Batches to gather.
    wanted: usize,
    /// Whether each task can be demonstrated.
    demonstrated: Vec<bool>,
    /// Unrolls in a regression step.
    unrolls: usize,
    unreported: Vec<Losses>,
}

impl WarmStart {
    /// Nothing gathered yet.
    pub(super) fn new(experiment: &Experiment, spec: &TaskSpec) -> Self {
        let rows = (experiment.unroll.batch * experiment.unroll.length) as u64;
        let config = &experiment.warm_start;
        Self {
            batches: Vec::new(),
            wanted: config.demonstration_steps.div_ceil(rows).max(1) as usize,
            demonstrated: spec.tasks.iter().map(|task| task.demonstrated).collect(),
            unrolls: config.minibatch_unrolls,
            unreported: Vec::new(),
        }
    }

    /// Whether there are as many demonstrations as the experiment wants.
    pub(super) fn is_complete(&self) -> bool {
        self.batches.len() >= self.wanted
    }

    /// Adds the demonstrations of a batch. A task without a reference has none: holding still is no example.
    ///
    /// # Errors
    /// When the device refuses the batch.
    pub(super) fn gather(&mut self, batch: &Batch, device: Device) -> Result<()> {
        let is_demonstrated = |task: usize| self.demonstrated.get(task).copied().unwrap_or_default();
        let demonstrated = Demonstrated::among(&batch.tasks(), is_demonstrated);
        if !demonstrated.unrolls.is_empty() {
            let valid = demonstrated.mask(batch.f32(Field::Valid));
            let tensors = masked_to_device(batch, &valid, self.demonstrated.len(), device)?;
            self.batches.push(Demonstrations { tensors, demonstrated });
        }
        Ok(())
    }

    /// One gradient step on some unrolls of one batch. The demonstrator has no latent, so z_{t−1} is the encoder's own: the
    /// one it gave when these unrolls were last chosen.
    ///
    /// # Errors
    /// When the batch does not fit the algorithm.
    pub(super) fn regress(&mut self, algorithm: &mut dyn Algorithm, random: &mut impl Rng) -> Result<()> {
        let index = random.random_range(0..self.batches.len());
        let Demonstrations { tensors, demonstrated } = &mut self.batches[index];
        let chosen = demonstrated.choose(self.unrolls, random);
        let (losses, latents) = algorithm.regress(&tensors.select(&chosen))?;
        tensors.refresh_previous_latent(&chosen, &latents);
        self.unreported.push(losses);
        Ok(())
    }

    /// The mean losses of the steps since the last time; `None` if there was no step.
    pub(super) fn take_losses(&mut self) -> Option<Losses> {
        Losses::mean(&std::mem::take(&mut self.unreported))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use proptest::prelude::*;
    use rand::SeedableRng as _;
    use rand_pcg::Pcg64;

    use super::*;

    proptest! {
        #[test]
        fn a_minibatch_has_one_size_whatever_the_mix_and_no_masked_unroll_without_need(
            tasks in prop::collection::vec(0_usize..2, 1..40), count in 1_usize..50, seed in any::<u64>(),
        ) {
            let demonstrated = Demonstrated::among(&tasks, |task| task == 0);
            let chosen = demonstrated.choose(count, &mut Pcg64::seed_from_u64(seed));
            prop_assert_eq!(chosen.len(), count.min(tasks.len()));
            prop_assert_eq!(chosen.iter().collect::<HashSet<_>>().len(), chosen.len(), "{:?} has one twice", &chosen);
            let of_reference = chosen.iter().filter(|unroll| tasks[**unroll] == 0).count();
            prop_assert_eq!(of_reference, count.min(tasks.iter().filter(|task| **task == 0).count()));
        }

        #[test]
        fn what_demonstrates_nothing_is_masked_and_nothing_else(
            unrolls in prop::collection::vec((0_usize..2, prop::collection::vec(0..=1_u8, 4)), 1..10),
        ) {
            let tasks: Vec<usize> = unrolls.iter().map(|(task, _)| *task).collect();
            let valid: Vec<f32> = unrolls.iter().flat_map(|(_, valid)| valid.iter().map(|valid| f32::from(*valid))).collect();
            let masked = Demonstrated::among(&tasks, |task| task == 0).mask(&valid);
            prop_assert_eq!(masked.len(), valid.len());
            for (row, (masked, valid)) in masked.iter().zip(valid).enumerate() {
                prop_assert_eq!(*masked, if tasks[row / 4] == 0 { valid } else { 0.0 });
            }
        }
    }
}
