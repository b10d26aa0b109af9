//! The batch that is learned from.

use std::sync::Arc;

use anyhow::{Context as _, Result};
use comic_experiment::{Experiment, TaskSpec};
use comic_learner::algorithm::minibatch::MinibatchTensors;
use comic_learner::algorithm::shape::MinibatchShape;
use comic_proto::{Field, UnrollLayout, UnrollShape};
use comic_replay::Unrolls;
use tch::{Device, Kind, Tensor};

/// A batch of random unrolls in the memory layout in which batches arrive.
pub(super) struct Recorded {
    shape: MinibatchShape,
    unrolls: Unrolls,
    tasks: Vec<usize>,
}

impl Recorded {
    pub(super) fn new(spec: &TaskSpec, experiment: &Experiment, count: usize) -> Result<Self> {
        let layout = Arc::new(UnrollLayout::new(UnrollShape::new(spec, experiment)));
        let unroll = *layout.shape();
        // The tasks take turns; each has one clip here.
        let tasks: Vec<usize> = (0..count).map(|index| index % spec.tasks.len()).collect();
        let rows = layout.rows(Field::Clip);
        let mut unrolls = Unrolls::new(layout, count);
        for field in Field::ALL {
            let values = unrolls.f32_mut(field);
            match field {
                Field::Discount | Field::Valid => values.fill(1.0),
                Field::Std => values.fill(0.7),
                Field::LogWeights => values.fill(-(unroll.components as f32).ln()),
                Field::First | Field::State | Field::Clip | Field::Image => {}
                Field::Proprioception
                | Field::Task
                | Field::PreviousLatent
                | Field::LatentNoise
                | Field::Action
                | Field::Mean
                | Field::ActionGradient
                | Field::Reward => Tensor::randn([values.len() as i64], (Kind::Float, Device::Cpu))
                    .f_copy_data(values, values.len())
                    .context("cannot copy random numbers")?,
            }
        }
        for (clips, task) in unrolls.clip_mut().chunks_exact_mut(rows).zip(&tasks) {
            clips.fill(*task as u32);
        }
        Ok(Self { unrolls, tasks, shape: MinibatchShape { unrolls: count, tasks: spec.tasks.len(), unroll } })
    }

    pub(super) fn to_tensors(&self, device: Device) -> Result<MinibatchTensors> {
        Ok(MinibatchTensors::new(&self.unrolls, &self.tasks, &self.shape, device)?)
    }
}
