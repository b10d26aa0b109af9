//! The result of one finished run.

use std::path::Path;

use anyhow::{Context, Result};

use crate::metrics;
use crate::train::evaluation;

/// The latent's KL is the mean over so many lines at the end of a run's metrics. Each line has that of one update.
const LAST_LINES: usize = 5;

/// The result of a finished run.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Outcome {
    /// Of the trained policy without noise over all starts, as are the next two.
    pub(super) normalised_reward: f64,
    /// Per survived step / the largest reward of a step.
    pub(super) reward_per_step: f64,
    /// Steps.
    pub(super) episode_length: f64,
    /// Nats per step.
    pub(super) latent_kl: Option<f64>,
    pub(super) environment_steps: f64,
    /// Wall clock since the first unroll.
    pub(super) minutes: f64,
}

impl Outcome {
    /// Reads the result of the run in `directory`. A run writes its evaluation last: without it the run is not finished.
    pub(super) fn read(directory: &Path) -> Result<Self> {
        let evaluations = evaluation::read(directory)?;
        let trained = evaluations.get("trained").with_context(|| {
            format!(
                "{} has no evaluation of a trained policy: the budget was used up before the first update",
                directory.display()
            )
        })?;
        let lines = metrics::read(&directory.join("metrics.jsonl"))?;
        let last = lines.last().with_context(|| format!("{} has no metrics", directory.display()))?;
        let kls: Vec<f64> = lines.iter().rev().filter_map(metrics::Line::latent_kl).take(LAST_LINES).collect();
        Ok(Self {
            normalised_reward: trained.overall.normalised_reward,
            reward_per_step: trained.overall.reward_per_step,
            episode_length: trained.overall.length_mean,
            latent_kl: (!kls.is_empty()).then(|| kls.iter().sum::<f64>() / kls.len() as f64),
            environment_steps: last.environment_steps as f64,
            minutes: last.seconds / 60.0,
        })
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_kl_is_that_of_the_last_lines_and_the_reward_that_of_the_trained_policy() {
        let directory = tempfile::tempdir().unwrap();
        let line = |number: u32| {
            let kl = if number < 3 { 100.0 } else { 4.0 };
            json!({ "seconds": 60 * number, "environment_steps": number, "losses": { "latent_kl": kl } }).to_string()
        };
        std::fs::write(directory.path().join("metrics.jsonl"), (1..8).map(|n| line(n) + "\n").collect::<String>())
            .unwrap();
        let overall = |reward: f64| {
            json!({ "clips": [], "overall": {
                "clip": "overall", "episodes": 1, "length_mean": 30.0, "return_mean": 1.0, "normalised_reward": reward,
                "reward_per_step": 0.5, "fraction_survived": 1.0, "reward_terms": {},
            } })
        };
        let evaluations = json!({ "untrained": overall(0.1), "trained": overall(0.4) });
        std::fs::write(directory.path().join("evaluation.json"), evaluations.to_string()).unwrap();
        assert_eq!(
            Outcome::read(directory.path()).unwrap(),
            Outcome {
                normalised_reward: 0.4,
                reward_per_step: 0.5,
                episode_length: 30.0,
                latent_kl: Some(4.0),
                environment_steps: 7.0,
                minutes: 7.0,
            }
        );
    }

    #[test]
    fn a_run_with_an_incomplete_evaluation_is_not_finished() {
        let directory = tempfile::tempdir().unwrap();
        std::fs::write(directory.path().join("metrics.jsonl"), "{}\n").unwrap();
        std::fs::write(directory.path().join("evaluation.json"), "{\"trained\": {\"cli").unwrap();
        assert!(Outcome::read(directory.path()).is_err());
    }
}
