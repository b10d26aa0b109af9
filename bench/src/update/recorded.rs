//! The batch that is learned from.

use anyhow::{Context as _, Result};
use comic_experiment::{Experiment, TaskSpec};
use comic_learner::algorithm::minibatch::{MinibatchSource, MinibatchTensors};
use comic_learner::algorithm::shape::MinibatchShape;
use comic_proto::{Field, PerField, UnrollLayout, UnrollShape};
use tch::{Device, Kind, Tensor};

/// A batch of random unrolls in the memory layout in which batches arrive.
pub(super) struct Recorded {
    shape: MinibatchShape,
    floats: PerField<Vec<f32>>,
    clips: Vec<u32>,
    tasks: Vec<usize>,
}

impl Recorded {
    pub(super) fn new(spec: &TaskSpec, experiment: &Experiment) -> Result<Self> {
        let layout = UnrollLayout::new(UnrollShape::new(spec, experiment));
        let (unroll, unrolls) = (*layout.shape(), experiment.unroll.batch);
        let mut floats = PerField::from_fn(|_| Vec::new());
        for (field, values) in floats.iter_mut() {
            let count = layout.elements(field) * unrolls;
            *values = match field {
                Field::Discount | Field::Valid => vec![1.0; count],
                Field::Std => vec![0.7; count],
                Field::LogWeights => vec![-(unroll.components as f32).ln(); count],
                Field::First | Field::State => vec![0.0; count],
                Field::Clip | Field::Image => Vec::new(),
                Field::Proprioception
                | Field::Task
                | Field::PreviousLatent
                | Field::LatentNoise
                | Field::Action
                | Field::Mean
                | Field::ActionGradient
                | Field::Reward => Vec::try_from(Tensor::randn([count as i64], (Kind::Float, Device::Cpu)))
                    .context("cannot copy random numbers")?,
            };
        }
        // The tasks take turns; each has one clip here.
        let tasks: Vec<usize> = (0..unrolls).map(|index| index % spec.tasks.len()).collect();
        Ok(Self {
            floats,
            clips: tasks.iter().flat_map(|task| vec![*task as u32; layout.rows(Field::Clip)]).collect(),
            tasks,
            shape: MinibatchShape { unrolls, tasks: spec.tasks.len(), unroll },
        })
    }

    pub(super) fn to_tensors(&self, device: Device) -> Result<MinibatchTensors> {
        let source = MinibatchSource {
            floats: self.floats.each_ref().map(|_, values| values.as_slice()),
            clip: &self.clips,
            image: &[],
            tasks: &self.tasks,
        };
        Ok(MinibatchTensors::new(&source, &self.shape, device)?)
    }
}
