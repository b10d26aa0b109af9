//! From a batch as the wire has it to minibatches on the device.

use anyhow::Result;
use comic_proto::{Field, PerField};
use comic_replay::Batch;
use rand::seq::SliceRandom as _;

use crate::algorithm::minibatch::{MinibatchSource, MinibatchTensors};
use crate::algorithm::shape::MinibatchShape;
use crate::train::trainer::Trainer;

impl Trainer {
    /// The batch on the device, `[B, T(+1), …]`.
    pub(crate) fn tensors(&self, batch: &Batch) -> Result<MinibatchTensors> {
        self.masked_tensors(batch, batch.f32(Field::Valid))
    }

    /// The same, of which only those rows count, `[B, T]`, whose `valid` is 1.
    pub(crate) fn masked_tensors(&self, batch: &Batch, valid: &[f32]) -> Result<MinibatchTensors> {
        let shape =
            MinibatchShape { unrolls: batch.unrolls, tasks: self.spec.tasks.len(), unroll: *batch.layout.shape() };
        let floats = PerField::from_fn(|field| if field == Field::Valid { valid } else { batch.f32(field) });
        let source = MinibatchSource { floats, clip: batch.clip(), image: batch.image(), tasks: &batch.tasks() };
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
