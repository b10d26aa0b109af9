//! What a trainer is made of, and how training ends.

use std::path::PathBuf;

use bytes::Bytes;
use comic_experiment::{Experiment, TaskSpec};
use comic_replay::Batcher;

use crate::checkpoint::Snapshot;
use crate::device::Backend;
use crate::publish::Publisher;
use crate::service::TrainerHandle;
use crate::world::World;

/// What a trainer is made of.
#[derive(Debug)]
pub struct TrainerParts {
    /// The resolved experiment, of all ranks together.
    pub experiment: Experiment,
    /// The task's sizes and names.
    pub spec: TaskSpec,
    /// The action at which the policy's mean starts, `[A]`.
    pub pose: Vec<f32>,
    /// In transfer: the file of the frozen low level, for checkpoints.
    pub low_level: Option<Bytes>,
    /// The device.
    pub backend: Backend,
    /// The ranks that train the run.
    pub world: World,
    /// The run's directory; only rank 0 writes there.
    pub run: PathBuf,
    /// The learner epoch.
    pub epoch: u64,
    /// A checkpoint to resume from.
    pub resume: Option<Snapshot>,
    /// The source of batches.
    pub batcher: Batcher,
    /// Where parameters are published.
    pub publisher: Publisher,
    /// The service, which shows the newest metrics and collects evaluations.
    pub service: TrainerHandle,
}

/// Why training ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// The experiment's budget is used up.
    Budget,
    /// The batcher was closed, because the learner was asked to stop.
    Stopped,
}
