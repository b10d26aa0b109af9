//! From a batch as the wire has it to minibatches on the device.

use comic_experiment::Experiment;
use comic_proto::{Field, PerField};
use comic_replay::Batch;
use rand::Rng;
use rand::seq::SliceRandom as _;
use tch::Device;

use crate::algorithm::minibatch::{MinibatchSource, MinibatchTensors};
use crate::algorithm::shape::MinibatchShape;
use crate::error::Result;

/// A batch of unrolls of any of `tasks` tasks on the device.
///
/// # Errors
/// When the device refuses.
pub(super) fn to_device(batch: &Batch, tasks: usize, device: Device) -> Result<MinibatchTensors> {
    masked_to_device(batch, batch.f32(Field::Valid), tasks, device)
}

/// As [`to_device`], with `valid`, `[B, T]`, in place of the batch's own: a row counts only where it is 1.
///
/// # Errors
/// When the device refuses.
pub(super) fn masked_to_device(batch: &Batch, valid: &[f32], tasks: usize, device: Device) -> Result<MinibatchTensors> {
    let shape = MinibatchShape { unrolls: batch.unrolls, tasks, unroll: *batch.layout.shape() };
    let floats = PerField::from_fn(|field| if field == Field::Valid { valid } else { batch.f32(field) });
    let source = MinibatchSource { floats, clip: batch.clip(), image: batch.image(), tasks: &batch.tasks() };
    Ok(MinibatchTensors::new(&source, &shape, device)?)
}

/// The unrolls of each gradient step on a batch: every unroll once before any comes again.
pub(super) fn draw(experiment: &Experiment, random: &mut impl Rng) -> Vec<Vec<usize>> {
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
