//! Evaluations: what `comic-actor evaluate --json` prints, and the file of those that a run's learner received.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

/// The file in a run's directory to which the learner appends every evaluation that is reported to it.
pub(crate) const FILE: &str = "evaluations.jsonl";

/// The members of the output of `comic-actor evaluate --json` that tables and pictures show.
#[derive(Clone, Debug, Deserialize, Serialize)]
pub(crate) struct Evaluation {
    /// Whether actions and latents were the means instead of samples.
    #[serde(default)]
    pub(crate) deterministic: bool,
    pub(crate) clips: Vec<ClipEvaluation>,
    /// In joint training the tasks, each over all its clips.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) tasks: Vec<ClipEvaluation>,
    pub(crate) overall: ClipEvaluation,
}

/// Means over the episodes of one clip, of one task, or of all.
#[derive(Clone, Debug, Deserialize, Serialize)]
pub(crate) struct ClipEvaluation {
    /// The name of the clip or task, or `overall`.
    pub(crate) clip: String,
    pub(crate) episodes: u64,
    /// Steps.
    pub(crate) length_mean: f64,
    pub(crate) return_mean: f64,
    /// Return / (the largest reward of a step × the steps that were left at the episode's start).
    pub(crate) normalised_reward: f64,
    /// Reward per survived step / the largest reward of a step.
    pub(crate) reward_per_step: f64,
    pub(crate) fraction_survived: f64,
    /// Absent in evaluations of earlier releases, as the three below.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) success_rate: Option<f64>,
    /// The task's measures of success, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub(crate) measures: BTreeMap<String, f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) tracking_error: Option<TrackingError>,
    /// m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) head_height: Option<f64>,
    /// Per survived step.
    pub(crate) reward_terms: BTreeMap<String, f64>,
}

/// Mean distances to the reference.
#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
pub(crate) struct TrackingError {
    pub(crate) position_mm: f64,
    pub(crate) local_position_mm: f64,
    pub(crate) velocity_mm_per_step: f64,
}

impl Evaluation {
    /// The means with this name.
    pub(crate) fn of(&self, clip: &str) -> Option<&ClipEvaluation> {
        self.clips.iter().chain(&self.tasks).chain([&self.overall]).find(|evaluation| evaluation.clip == clip)
    }
}

/// A line of `evaluations.jsonl`: an evaluation, and how far the run was at the checkpoint that was evaluated.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct Line {
    #[serde(default)]
    pub(crate) updates: u64,
    /// 0 if the evaluation was started by hand, or by an earlier release.
    #[serde(default)]
    pub(crate) environment_steps: u64,
    /// Wall clock since the first unroll, seconds, cumulative over restarts.
    #[serde(default)]
    pub(crate) seconds: f64,
    pub(crate) evaluation: Evaluation,
}

impl Line {
    /// `None` if the text is not an evaluation. The learner keeps whatever is reported.
    pub(crate) fn parse(text: &str) -> Option<Self> {
        serde_json::from_str(text).ok()
    }

    /// Whether this is a point of a learning curve: the policy acted without noise, and its place in the run is known.
    pub(crate) fn is_on_curve(&self) -> bool {
        self.environment_steps > 0 && self.evaluation.deterministic
    }
}

/// The lines of the file that are points of a learning curve, with increasing environment steps. No file has no lines.
///
/// # Errors
/// The file exists and cannot be read.
pub(crate) fn read(path: &Path) -> Result<Vec<Line>> {
    let text = match std::fs::read_to_string(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        text => text.with_context(|| format!("cannot read {}", path.display()))?,
    };
    let mut lines: Vec<Line> = Vec::new();
    for line in text.lines().filter_map(Line::parse).filter(Line::is_on_curve) {
        // A killed run repeats the steps after its last checkpoint. The newer lines replace the older ones.
        lines.truncate(lines.partition_point(|earlier| earlier.environment_steps < line.environment_steps));
        lines.push(line);
    }
    Ok(lines)
}

/// The largest normalised reward among the lines that [`read`] gives; `None` without a line.
pub(crate) fn best(path: &Path) -> Option<f64> {
    let lines = read(path).ok()?;
    lines.iter().map(|line| line.evaluation.overall.normalised_reward).reduce(f64::max)
}

/// A line as the learner writes it: one minute for each million environment steps, and a normalised reward for each clip.
#[cfg(test)]
pub(crate) fn example(environment_steps: u64, clips: &[(&str, f64)]) -> String {
    let means = |clip: &str, reward: f64| {
        serde_json::json!({
            "clip": clip, "episodes": 2, "diverged": 0, "length_mean": 40.0, "return_mean": 50.0 * reward,
            "normalised_reward": reward, "reward_per_step": reward, "fraction_survived": 1.0, "success_rate": 0.75,
            "head_height": 1.4, "reward_terms": { "com": 0.01 },
        })
    };
    let overall = clips.iter().map(|(_, reward)| reward).sum::<f64>() / clips.len() as f64;
    let clips: Vec<_> = clips.iter().map(|(clip, reward)| means(clip, *reward)).collect();
    let line = serde_json::json!({
        "run": "1", "learner_epoch": 1, "version": 3, "updates": 2, "environment_steps": environment_steps,
        "seconds": environment_steps as f64 * 60.0 / 1e6,
        "evaluation": {
            "deterministic": true, "noise": 0.0, "seed": 1, "clips": clips, "overall": means("overall", overall),
        },
    });
    format!("{line}\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The environment steps and the overall normalised rewards in a file with this text.
    fn read_text(text: &str) -> Vec<(u64, f64)> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(FILE);
        std::fs::write(&path, text).unwrap();
        let lines = read(&path).unwrap();
        assert_eq!(best(&path), lines.iter().map(|line| line.evaluation.overall.normalised_reward).reduce(f64::max));
        lines.iter().map(|line| (line.environment_steps, line.evaluation.overall.normalised_reward)).collect()
    }

    #[test]
    fn only_evaluations_without_noise_at_a_known_place_are_points_of_a_curve() {
        let noisy = example(2000, &[("walk", 0.9)]).replace("\"deterministic\":true", "\"deterministic\":false");
        let by_hand = example(0, &[("walk", 0.9)]);
        let older_release = by_hand.replace("\"environment_steps\":0,", "").replace("\"seconds\":0.0,", "");
        assert!(Line::parse(&older_release).is_some(), "{older_release}");
        let nothing = "{\"updates\":3,\"evaluation\":null}\n";
        let torn = "{\"updates\":3,\"eva";
        let point = example(1000, &[("walk", 0.25)]);
        assert_eq!(read_text(&format!("{noisy}{by_hand}{older_release}{point}{nothing}{torn}")), [(1000, 0.25)]);
    }

    #[test]
    fn steps_repeated_after_a_crash_are_read_once() {
        let lines = [(1000, 0.25), (2000, 0.75), (3000, 0.75), (2000, 0.5)];
        let text = lines.map(|(steps, reward)| example(steps, &[("walk", reward)])).concat();
        assert_eq!(read_text(&text), [(1000, 0.25), (2000, 0.5)]);
    }

    #[test]
    fn a_run_without_evaluations_has_no_line() {
        let directory = tempfile::tempdir().unwrap();
        assert!(read(&directory.path().join(FILE)).unwrap().is_empty());
        assert_eq!(best(&directory.path().join(FILE)), None);
    }
}
