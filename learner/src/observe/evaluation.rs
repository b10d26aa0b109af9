//! Evaluations that actors report.

use bytes::Bytes;

use crate::checkpoint::Evaluated;

/// An evaluation that an actor reported.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Evaluation {
    /// The run whose parameters were evaluated: the learner's own.
    pub run: u64,
    /// The learner epoch of the parameters.
    pub epoch: u64,
    /// The version of the parameters.
    pub version: u64,
    /// Updates before the checkpoint that holds them.
    pub updates: u64,
    /// Environment steps before that checkpoint; 0 if the actor does not know.
    pub environment_steps: u64,
    /// Wall-clock seconds from the run's first unroll to that checkpoint; 0 if the actor does not know.
    pub seconds: f64,
    /// As `comic-actor evaluate --json` prints it.
    pub json: String,
    /// A GIF of an episode; empty if there is none. Nobody has checked it.
    pub film: Bytes,
}

impl Evaluation {
    /// Whether its place in the run is known. Only the initial checkpoint has no environment steps.
    pub(super) fn has_place(&self) -> bool {
        self.environment_steps > 0 || self.updates == 0
    }

    /// The result that checkpoints are compared by; `None` if the report has no mean.
    pub(crate) fn evaluated(&self) -> Option<Evaluated> {
        let report: serde_json::Value = serde_json::from_str(&self.json).ok()?;
        let normalised_reward = report["overall"]["normalised_reward"].as_f64()?;
        Some(Evaluated { run: self.run, epoch: self.epoch, updates: self.updates, normalised_reward })
    }
}
