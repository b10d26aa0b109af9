//! From a batch as the wire has it to minibatches on the device.

use anyhow::Result;
use comic_proto::Field;
use comic_replay::Batch;
use rand::seq::SliceRandom as _;

use crate::train::trainer::Trainer;
use crate::vmpo::{MinibatchShape, MinibatchSource, MinibatchTensors};

impl Trainer {
    /// The batch on the device, `[B, T(+1), …]`.
    pub(crate) fn tensors(&self, batch: &Batch) -> Result<MinibatchTensors> {
        self.masked_tensors(batch, batch.f32(Field::Valid))
    }

    /// The same, of which only those rows count, `[B, T]`, whose `valid` is 1.
    pub(crate) fn masked_tensors(&self, batch: &Batch, valid: &[f32]) -> Result<MinibatchTensors> {
        let shape =
            MinibatchShape { unrolls: batch.unrolls, tasks: self.spec.tasks.len(), unroll: *batch.layout.shape() };
        let source = MinibatchSource {
            proprioception: batch.f32(Field::Proprioception),
            task: batch.f32(Field::Task),
            previous_latent: batch.f32(Field::PreviousLatent),
            latent_noise: batch.f32(Field::LatentNoise),
            action: batch.f32(Field::Action),
            mean: batch.f32(Field::Mean),
            std: batch.f32(Field::Std),
            log_weights: batch.f32(Field::LogWeights),
            reward: batch.f32(Field::Reward),
            discount: batch.f32(Field::Discount),
            valid,
            first: batch.f32(Field::First),
            state: batch.f32(Field::State),
            clip: batch.clip(),
            image: batch.image(),
            tasks: &batch.tasks(),
        };
        Ok(MinibatchTensors::new(&source, &shape, self.learner.device())?)
    }

    /// The gradient steps' minibatches: every unroll once before any comes again.
    pub(crate) fn minibatches<'a>(
        &mut self,
        tensors: &'a MinibatchTensors,
    ) -> impl Iterator<Item = MinibatchTensors> + use<'a> {
        let unrolls = self.experiment.unroll.batch;
        let size = self.experiment.vmpo.minibatch_unrolls;
        let steps = self.experiment.vmpo.gradient_steps;
        let mut order: Vec<usize> = Vec::new();
        while order.len() < steps * size {
            let mut pass: Vec<usize> = (0..unrolls).collect();
            // With the whole batch in each step, order means nothing; keep it, so that sums are those of the batch.
            if size < unrolls {
                pass.shuffle(&mut self.progress.random);
            }
            order.extend(pass);
        }
        (0..steps).map(move |step| tensors.select(&order[step * size..(step + 1) * size]))
    }
}
