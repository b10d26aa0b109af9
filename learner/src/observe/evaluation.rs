//! Evaluations that actors report.

use bytes::Bytes;

use crate::checkpoint::Evaluated;
use crate::checkpoint::progress::Progress;

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

    /// Whether a checkpoint of this place can be there when the run has made so much progress.
    pub(crate) fn is_before(&self, progress: &Progress) -> bool {
        self.epoch <= progress.epoch
            && self.updates <= progress.updates
            && self.environment_steps <= progress.environment_steps
            && (0.0..=progress.seconds).contains(&self.seconds)
    }

    /// The result that checkpoints are compared by; `None` if the report has no mean.
    pub(crate) fn evaluated(&self) -> Option<Evaluated> {
        let report: serde_json::Value = serde_json::from_str(&self.json).ok()?;
        let normalised_reward = report["overall"]["normalised_reward"].as_f64()?;
        Some(Evaluated { run: self.run, epoch: self.epoch, updates: self.updates, normalised_reward })
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_pcg::Pcg64;

    use super::*;

    #[test]
    fn a_place_that_the_run_has_not_reached_is_none_of_its_checkpoints() {
        let progress = Progress {
            format: 0,
            run: Some(1),
            epoch: 2,
            updates: 10,
            gradient_steps: 10,
            environment_steps: 1000,
            seconds: 60.0,
            version: 11,
            random: Pcg64::seed_from_u64(1),
        };
        let reached =
            Evaluation { epoch: 2, updates: 10, environment_steps: 1000, seconds: 60.0, ..Evaluation::default() };
        assert!(reached.is_before(&progress) && Evaluation::default().is_before(&progress));
        for beyond in [
            Evaluation { epoch: u64::MAX, ..Evaluation::default() },
            Evaluation { updates: 11, ..reached.clone() },
            Evaluation { environment_steps: u64::MAX, ..reached.clone() },
            Evaluation { seconds: 1e308, ..reached.clone() },
            Evaluation { seconds: -1.0, ..reached.clone() },
            Evaluation { seconds: f64::NAN, ..reached.clone() },
        ] {
            assert!(!beyond.is_before(&progress), "{beyond:?}");
        }
    }
}
