//! How far a run has come.

use rand_pcg::Pcg64;
use serde::{Deserialize, Serialize};

use crate::checkpoint::snapshot::{PROGRESS, Snapshot};
use crate::error::{Error, Result};

/// Everything that is counted, in checkpoints as `progress.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Progress {
    /// The format of the checkpoint: [`CHECKPOINT_FORMAT`](comic_experiment::CHECKPOINT_FORMAT).
    pub(crate) format: u32,
    /// The run's number; absent from checkpoints of learners that had none.
    #[serde(default)]
    pub(crate) run: Option<u64>,
    /// The learner epoch that made the checkpoint.
    pub(crate) epoch: u64,
    /// Batches trained on.
    pub(crate) updates: u64,
    /// Gradient steps, those that were skipped included.
    pub(crate) gradient_steps: u64,
    /// Environment steps trained on.
    pub(crate) environment_steps: u64,
    /// Wall-clock seconds since the first unroll, without the time between two starts of the learner.
    pub(crate) seconds: f64,
    /// The newest published version.
    pub(crate) version: u64,
    /// Decides the minibatches.
    pub(crate) random: Pcg64,
}

impl Progress {
    /// The progress that a checkpoint holds.
    ///
    /// # Errors
    /// When the part is absent or damaged.
    pub(crate) fn of(snapshot: &Snapshot) -> Result<Self> {
        serde_json::from_slice(snapshot.part(PROGRESS)?).map_err(Error::json("the checkpoint's progress"))
    }
}
