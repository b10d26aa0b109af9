//! The batch that is learned from.

use anyhow::{Context as _, Result};
use comic_experiment::{Experiment, TaskSpec};
use comic_learner::vmpo::{MinibatchShape, MinibatchSource, MinibatchTensors};
use comic_proto::UnrollShape;
use tch::{Device, Kind, Tensor};

/// A batch of random unrolls in the memory layout in which batches arrive.
pub(super) struct Recorded {
    shape: MinibatchShape,
    floats: [Vec<f32>; 13],
    clips: Vec<u32>,
    tasks: Vec<usize>,
}

impl Recorded {
    pub(super) fn new(spec: &TaskSpec, experiment: &Experiment) -> Result<Self> {
        let shape = UnrollShape::new(spec, experiment);
        let unrolls = experiment.unroll.batch;
        let (rows, observations) = (unrolls * shape.length, unrolls * (shape.length + 1));
        let (components, weights) = (shape.components, if shape.components > 1 { shape.components } else { 0 });
        let random = |count: usize| {
            Vec::<f32>::try_from(Tensor::randn([count as i64], (Kind::Float, Device::Cpu))).context("random numbers")
        };
        // The tasks take turns; each has one clip here.
        let tasks: Vec<usize> = (0..unrolls).map(|unroll| unroll % spec.tasks.len()).collect();
        Ok(Self {
            floats: [
                random(observations * shape.proprioception)?,
                random(observations * shape.task)?,
                random(rows * shape.latent)?,
                random(rows * shape.latent)?,
                random(rows * shape.action)?,
                random(rows * components * shape.action)?,
                vec![0.7; rows * components * shape.action],
                vec![-(components as f32).ln(); rows * weights],
                random(rows * shape.reward_terms)?,
                vec![1.0; rows],
                vec![1.0; rows],
                vec![0.0; observations],
                vec![0.0; unrolls * shape.state],
            ],
            clips: tasks.iter().flat_map(|task| vec![*task as u32; shape.length + 1]).collect(),
            tasks,
            shape: MinibatchShape { unrolls, tasks: spec.tasks.len(), unroll: shape },
        })
    }

    pub(super) fn to_tensors(&self, device: Device) -> Result<MinibatchTensors> {
        let [
            proprioception,
            task,
            previous_latent,
            latent_noise,
            action,
            mean,
            std,
            log_weights,
            reward,
            discount,
            valid,
            first,
            state,
        ] = &self.floats;
        let source = MinibatchSource {
            proprioception,
            task,
            previous_latent,
            latent_noise,
            action,
            mean,
            std,
            log_weights,
            reward,
            discount,
            valid,
            first,
            state,
            clip: &self.clips,
            image: &[],
            tasks: &self.tasks,
        };
        Ok(MinibatchTensors::new(&source, &self.shape, device)?)
    }
}
