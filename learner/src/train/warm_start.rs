//! The warm start: regression towards the servo action on demonstrations that actors make.

use std::sync::Arc;

use anyhow::Result;
use comic_proto::Field;
use comic_proto::v1::Behaviour;
use rand::Rng;
use rand::seq::index::sample;

use crate::algorithm::Algorithm as _;
use crate::algorithm::losses::Losses;
use crate::algorithm::minibatch::MinibatchTensors;
use crate::checkpoint::Name;
use crate::train::trainer::{Trainer, Wait};

/// Which unrolls of a batch demonstrate something; the others are masked.
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

    /// `count` different unrolls, or all there are: demonstrated ones at random, and masked ones where these are too few,
    /// since each size that the mix of tasks made would have to be compiled.
    fn choose(&self, count: usize, random: &mut impl Rng) -> Vec<usize> {
        let places = sample(random, self.unrolls.len(), self.unrolls.len().min(count));
        let demonstrated = places.into_iter().filter_map(|place| self.unrolls.get(place));
        demonstrated.chain(&self.masked).copied().take(count).collect()
    }
}

/// A batch of the servo's rollouts.
struct Demonstrations {
    tensors: MinibatchTensors,
    demonstrated: Demonstrated,
}

impl Trainer {
    /// Gathers demonstrations, regresses on them, and leaves the checkpoint `warm-started`. `None` when the learner was
    /// asked to stop meanwhile; the warm start then begins anew next time.
    pub(crate) fn warm_start(&mut self) -> Result<Option<()>> {
        self.publish(Behaviour::Demonstration)?;
        tracing::info!(steps = self.experiment.warm_start.demonstration_steps, "gathering demonstrations");
        let Some(mut demonstrations) = self.gather()? else { return Ok(None) };
        if self.experiment.network.normaliser_steps > 0 {
            self.set_normaliser()?;
        }
        // Without the scale of the observations there would be no way on from the state before.
        self.good = Arc::new(self.snapshot()?);
        let config = self.experiment.warm_start.clone();
        tracing::info!(steps = config.steps, "regressing on them");
        let (mut unreported, mut step) = (Vec::new(), 0);
        // A last step that was skipped is made up for: what is not sound would not be published.
        while step < config.steps || !self.is_sound() {
            self.learner.set_learning_rates(config.learning_rate, self.experiment.optimiser.multiplier_learning_rate);
            unreported.push(self.regress(&mut demonstrations, config.minibatch_unrolls)?);
            self.backend.end_step()?;
            if (step % 50 == 0 || step + 1 >= config.steps)
                && let Some(losses) = Losses::mean(&std::mem::take(&mut unreported))
            {
                let losses = losses.to_values();
                tracing::info!(
                    step,
                    regression = losses.get("regression_loss"),
                    latent_kl = losses.get("latent_kl"),
                    "regressing"
                );
                if self.report(&losses)? {
                    step = 0;
                    continue;
                }
            }
            step += 1;
            self.write_metrics_when_due()?;
            if self.batcher.is_closed() {
                return Ok(None);
            }
        }
        self.learner.reset_optimiser();
        self.progress.warm_started = true;
        self.publish(Behaviour::Policy)?;
        self.keep(Name::WarmStarted)?;
        Ok(Some(()))
    }

    /// Batches of the servo's rollouts, of at least `demonstration_steps` rows in all.
    fn gather(&mut self) -> Result<Option<Vec<Demonstrations>>> {
        let unroll = &self.experiment.unroll;
        let rows = (unroll.batch * unroll.length) as u64;
        let wanted = self.experiment.warm_start.demonstration_steps.div_ceil(rows).max(1);
        let mut demonstrations = Vec::new();
        while (demonstrations.len() as u64) < wanted {
            match self.next_batch()? {
                Wait::Batch(batch) => {
                    // What has no reference has nothing to demonstrate: holding still is no example.
                    let demonstrated = Demonstrated::among(&batch.tasks(), |task| {
                        self.spec.tasks.get(task).is_some_and(|task| task.demonstrated)
                    });
                    if !demonstrated.unrolls.is_empty() {
                        let valid = demonstrated.mask(batch.f32(Field::Valid));
                        let tensors = self.masked_tensors(&batch, &valid)?;
                        demonstrations.push(Demonstrations { tensors, demonstrated });
                    }
                    self.absorb(&batch);
                    self.metrics.absorb(batch.headers(), 0);
                    if (demonstrations.len() as u64) < wanted {
                        self.keep_step(Behaviour::Demonstration);
                    }
                    self.book(batch);
                }
                Wait::Nothing => {}
                Wait::Closed => return Ok(None),
            }
        }
        Ok(Some(demonstrations))
    }

    /// One step on some unrolls of one batch. The demonstrator has no latent, so z_{t−1} is this encoder's own: what it
    /// gave when it last saw these unrolls.
    fn regress(&mut self, demonstrations: &mut [Demonstrations], unrolls: usize) -> Result<Losses> {
        let random = &mut self.progress.random;
        let batch = &mut demonstrations[random.random_range(0..demonstrations.len())];
        let chosen = batch.demonstrated.choose(unrolls, random);
        let (losses, latents) = self.learner.regress(&batch.tensors.select(&chosen))?;
        batch.tensors.refresh_previous_latent(&chosen, &latents);
        Ok(losses)
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
