//! The lines of `metrics.jsonl`, as the learner writes them, and of baselines' files.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result};
use comic_experiment::Budget;
use serde::{Deserialize, Serialize};

/// The members of a line that curves and displays need. A mean over no episodes is absent.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub(crate) struct Line {
    /// Wall clock since the first unroll, seconds, cumulative over restarts.
    pub(crate) seconds: f64,
    #[serde(alias = "env_steps")]
    pub(crate) environment_steps: u64,
    pub(crate) updates: u64,
    pub(crate) version: u64,
    pub(crate) steps_per_second: Option<f64>,
    /// Reward per survived step / the largest reward of a step.
    pub(crate) reward_per_step: Option<f64>,
    /// Steps.
    #[serde(alias = "length")]
    pub(crate) episode_length: Option<f64>,
    pub(crate) episode_return: Option<f64>,
    /// Return / (the largest reward of a step × the steps that were left at the episode's start).
    pub(crate) normalised_reward: Option<f64>,
    pub(crate) fraction_survived: Option<f64>,
    /// m.
    pub(crate) head_height: Option<f64>,
    /// Versions between the parameters that acted and those that were updated.
    pub(crate) unroll_age: Option<f64>,
    pub(crate) accounting: Option<Accounting>,
    /// The learner's losses by name.
    pub(crate) losses: BTreeMap<String, serde_json::Value>,
    /// In joint training the same for each task's own episodes.
    pub(crate) tasks: BTreeMap<String, Line>,
}

impl Line {
    /// The used fraction of the budget, 0 to 1, by the limit that is nearest.
    pub(crate) fn used(&self, budget: &Budget) -> f64 {
        let of = |used: f64, limit: f64| if limit > 0.0 { used / limit } else { 0.0 };
        of(self.seconds, budget.minutes * 60.0)
            .max(of(self.environment_steps as f64, budget.environment_steps as f64))
            .max(of(self.updates as f64, budget.updates as f64))
            .clamp(0.0, 1.0)
    }

    /// KL divergence of the latent from its prior in the newest update, nats per step.
    pub(crate) fn latent_kl(&self) -> Option<f64> {
        self.losses.get("latent_kl")?.as_f64()
    }
}

/// Every line of a file of metrics. A last line that is cut off is left out: the learner writes it, or was killed.
pub(crate) fn read(path: &Path) -> Result<Vec<Line>> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let line = |(number, line)| {
        serde_json::from_str(line).with_context(|| format!("{}:{}: not a line of metrics", path.display(), number + 1))
    };
    let whole = text.rfind('\n').map_or(0, |end| end + 1);
    let last = serde_json::from_str(&text[whole..]).ok();
    text[..whole].lines().enumerate().map(line).chain(last.map(Ok)).collect()
}

/// produced = trained + dropped + in flight.
#[derive(Clone, Debug, Default, Deserialize, Serialize)]
#[serde(default)]
pub(crate) struct Accounting {
    pub(crate) produced: u64,
    pub(crate) trained: u64,
    pub(crate) dropped: BTreeMap<String, u64>,
    pub(crate) in_flight: u64,
}

impl Accounting {
    /// Whether the sum holds.
    pub(crate) fn balances(&self) -> bool {
        let parts = self.dropped.values().chain([&self.trained, &self.in_flight]);
        parts.copied().try_fold(0, u64::checked_add) == Some(self.produced)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_learners_line_is_read_with_its_absent_means() {
        let line: Line = serde_json::from_str(
            r#"{"seconds":5.0,"environment_steps":4096,"updates":1,"version":1,"episode_length":null,
                "reward_terms":{"com":null},"losses":{"latent_kl":4.5},
                "accounting":{"produced":3,"trained":2,"dropped":{"stale":1},"in_flight":0}}"#,
        )
        .unwrap();
        assert_eq!(line.environment_steps, 4096);
        assert!(line.episode_length.is_none());
        assert_eq!(line.latent_kl(), Some(4.5));
        assert_eq!(line.accounting.unwrap().dropped["stale"], 1);
    }

    #[test]
    fn a_line_that_cannot_be_read_is_named() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("metrics.jsonl");
        std::fs::write(&path, "{}\nnonsense\n").unwrap();
        let error = read(&path).unwrap_err();
        assert!(format!("{error:#}").contains("metrics.jsonl:2"), "{error:#}");
    }

    #[test]
    fn a_last_line_that_is_cut_off_is_left_out() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("metrics.jsonl");
        for (last, lines) in [(r#"{"upda"#, 1), (r#"{"updates":2}"#, 2), ("", 1)] {
            std::fs::write(&path, format!("{{}}\n{last}")).unwrap();
            assert_eq!(read(&path).unwrap().len(), lines, "{last}");
        }
    }

    #[test]
    fn a_baselines_line_is_read() {
        let line: Line = serde_json::from_str(
            r#"{"seconds": 30, "env_steps": 8030, "episode_return": 1.084, "length": 6.32, "normalised": 0.1183}"#,
        )
        .unwrap();
        assert_eq!((line.seconds, line.environment_steps, line.episode_return), (30.0, 8030, Some(1.084)));
    }
}
