//! The newest batch, on which V-MPO learns.

use std::time::Duration;

use comic_experiment::Experiment;
use comic_replay::{Batch, Batcher, Next};
use rand::Rng;
use rand::seq::SliceRandom as _;
use rand_pcg::Pcg64;
use tch::Device;

use crate::algorithm::experience::Experience;
use crate::algorithm::minibatch::{MinibatchTensors, to_device};
use crate::error::{Error, Result};

/// The newest batch alone: on-policy.
#[derive(Debug)]
pub(super) struct Newest {
    experiment: Experiment,
    tasks: usize,
    device: Device,
    /// The batch on the device, and the unrolls of each gradient step.
    batch: Option<(MinibatchTensors, Vec<Vec<usize>>)>,
}

impl Experience for Newest {
    fn next(&mut self, batcher: &Batcher, patience: Duration) -> Next {
        batcher.next_batch_within(patience)
    }

    fn take(&mut self, batch: &Batch, random: &mut Pcg64) -> Result<usize> {
        let tensors = tracing::debug_span!("to_device").in_scope(|| to_device(batch, self.tasks, self.device))?;
        let steps = draw(&self.experiment, random);
        let count = steps.len();
        self.batch = Some((tensors, steps));
        Ok(count)
    }

    fn minibatch(&mut self, step: usize, _: &mut Pcg64) -> Result<MinibatchTensors> {
        let chosen = self.batch.as_ref().and_then(|(tensors, steps)| Some(tensors.select(steps.get(step)?)));
        chosen.ok_or_else(|| Error::Defect("a gradient step has no batch".into()))
    }

    fn release(&mut self) {
        self.batch = None;
    }
}

impl Newest {
    pub(super) fn new(experiment: &Experiment, tasks: usize, device: Device) -> Self {
        Self { experiment: experiment.clone(), tasks, device, batch: None }
    }
}

/// The unrolls of each gradient step on a batch: every unroll once before any comes again.
fn draw(experiment: &Experiment, random: &mut impl Rng) -> Vec<Vec<usize>> {
    let unrolls = experiment.unroll.batch;
    let (size, steps) = (experiment.vmpo.minibatch_unrolls.max(1), experiment.vmpo.gradient_steps);
    let mut order: Vec<usize> = Vec::new();
    while order.len() < steps * size {
        let mut pass: Vec<usize> = (0..unrolls).collect();
        // If each step takes the whole batch, the order does not matter; without a shuffle the sums are the batch's own.
        if size < unrolls {
            pass.shuffle(random);
        }
        order.extend(pass);
    }
    order.chunks_exact(size).take(steps).map(<[usize]>::to_vec).collect()
}
