//! The result of an evaluation.

use std::collections::BTreeMap;

use comic_experiment::{TaskPart, TaskSpec};
use comic_tasks::{Achievement, MAX_REWARD_TERMS, Outcome};
use serde::{Deserialize, Serialize};

use super::settings::RolloutSettings;
use super::tracking_errors::TrackingSums;
use crate::page::recorder::Ending;

/// An episode that is over.
#[derive(Clone, Debug, PartialEq)]
pub struct Finished {
    /// The number of its start.
    pub number: usize,
    /// The clip's index.
    pub clip: usize,
    /// Frame within the clip.
    pub start: usize,
    /// Steps that were left in the clip at the start.
    pub steps_left: usize,
    /// The reward of each step.
    pub rewards: Vec<f64>,
    /// Sums of the reward terms.
    pub returns: [f64; MAX_REWARD_TERMS],
    /// Sum of the head's heights after each step, m.
    pub head_heights: f64,
    /// Sums of the distances to the reference.
    pub tracking: TrackingSums,
    /// What it achieved, by the task's own definition.
    pub achievement: Achievement,
    /// Why the episode ended.
    pub outcome: Outcome,
}

impl Finished {
    /// Number of steps.
    pub fn steps(&self) -> usize {
        self.rewards.len()
    }

    /// What a page says of its end.
    pub(crate) fn ending(&self, spec: &TaskSpec, remark: String) -> Ending {
        let (number, outcome) = (self.number, self.outcome);
        Ending { number, remark, outcome, normalised_reward: self.normalised_reward(spec) }
    }

    /// Return / (largest reward of a step × steps left at the start).
    pub fn normalised_reward(&self, spec: &TaskSpec) -> f64 {
        ratio(self.returns.iter().sum(), spec.max_reward(self.clip) * self.steps_left as f64)
    }
}

/// An evaluation: `comic-actor evaluate --json` prints exactly this.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Report {
    /// Whether actions and latents were the means instead of samples.
    pub deterministic: bool,
    /// Standard deviation of the noise that was added to mean actions.
    #[serde(default)]
    pub noise: f32,
    /// Seed of random starts and noise.
    pub seed: u64,
    /// One for each clip that has a start, in the clips' order.
    pub clips: Vec<ClipReport>,
    /// In joint training one for each task, in the tasks' order, over the episodes of all its clips.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub tasks: Vec<ClipReport>,
    /// Over all episodes of all clips.
    pub overall: ClipReport,
}

/// The episodes of one clip. Means are over episodes unless said otherwise.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClipReport {
    /// The clip's name; `overall` for all of them.
    pub clip: String,
    /// Number of episodes.
    pub episodes: usize,
    /// Episodes that ended because the simulation diverged.
    pub diverged: usize,
    /// Mean number of steps.
    pub length_mean: f64,
    /// Mean return.
    pub return_mean: f64,
    /// Mean of return / (largest reward of a step × steps left at the start).
    pub normalised_reward: f64,
    /// Mean over all steps of reward / largest reward of a step.
    pub reward_per_step: f64,
    /// Mean of steps / steps left in the clip at the start.
    pub fraction_survived: f64,
    /// Share of the episodes that are a success by the task's own definition (`docs/tasks.md`): in tracking they lasted to the
    /// clip's end. (PHC has another rule for a failure: a mean distance above 0.5 m.)
    pub success_rate: f64,
    /// Means of the task's measures of success, by name; in joint training over the episodes of the tasks that have them.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub measures: BTreeMap<String, f64>,
    /// Mean distances to the reference; absent in a task without a reference.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tracking_error: Option<TrackingError>,
    /// Mean over all steps of the head's height, m; 0 in a step that diverged.
    pub head_height: f64,
    /// Mean over all steps of each reward term.
    pub reward_terms: BTreeMap<String, f64>,
}

/// Means over all steps of the distances between the bodies and the reference's, as PHC (Luo et al., 2023) defines them.
/// The bodies are the root and those that tracking compares.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrackingError {
    /// Distance in the world, mm (E_g-mpjpe).
    pub position_mm: f64,
    /// Distance when both roots are at the same place, mm (E_mpjpe).
    pub local_position_mm: f64,
    /// Difference of the velocities, mm per control step (E_vel).
    pub velocity_mm_per_step: f64,
}

impl TrackingError {
    fn of(finished: &[&Finished]) -> Option<Self> {
        let steps: usize = finished.iter().map(|episode| episode.tracking.steps).sum();
        let mean = |sum: &dyn Fn(&TrackingSums) -> f64| {
            1e3 * ratio(finished.iter().map(|episode| sum(&episode.tracking)).sum(), steps as f64)
        };
        (steps > 0).then(|| Self {
            position_mm: mean(&|sums| sums.position),
            local_position_mm: mean(&|sums| sums.local_position),
            velocity_mm_per_step: mean(&|sums| sums.velocity),
        })
    }
}

impl Report {
    /// Sums up `finished` over the clips of `spec`.
    pub fn new(spec: &TaskSpec, finished: &[Finished], options: &RolloutSettings) -> Self {
        let clips = spec
            .clips
            .iter()
            .enumerate()
            .map(|(index, name)| {
                let of_clip: Vec<&Finished> = finished.iter().filter(|e| e.clip == index).collect();
                ClipReport::new(name, spec, &of_clip)
            })
            .filter(|clip| clip.episodes > 0)
            .collect();
        let of_task = |(index, task): (usize, &TaskPart)| {
            let own: Vec<&Finished> = finished.iter().filter(|e| spec.task_of(e.clip) == index).collect();
            ClipReport::new(&task.name, spec, &own)
        };
        let several = spec.tasks.len() > 1;
        let tasks = spec.tasks.iter().enumerate().filter(|_| several).map(of_task).collect();
        let overall = ClipReport::new("overall", spec, &finished.iter().collect::<Vec<_>>());
        Self { deterministic: options.deterministic, noise: options.noise, seed: options.seed, clips, tasks, overall }
    }
}

impl ClipReport {
    fn new(clip: &str, spec: &TaskSpec, finished: &[&Finished]) -> Self {
        let mean =
            |value: &dyn Fn(&Finished) -> f64| ratio(finished.iter().copied().map(value).sum(), finished.len() as f64);
        let total = |episode: &Finished| episode.returns.iter().sum::<f64>();
        let steps: f64 = finished.iter().map(|episode| episode.steps() as f64).sum();
        let most = |episode: &Finished| spec.max_reward(episode.clip);
        let per_step = |value: &dyn Fn(&Finished) -> f64| ratio(finished.iter().copied().map(value).sum(), steps);
        Self {
            clip: clip.to_string(),
            episodes: finished.len(),
            diverged: finished.iter().filter(|episode| episode.outcome == Outcome::Diverged).count(),
            length_mean: mean(&|episode| episode.steps() as f64),
            return_mean: mean(&total),
            normalised_reward: mean(&|episode| episode.normalised_reward(spec)),
            reward_per_step: per_step(&|episode| ratio(total(episode), most(episode))),
            fraction_survived: mean(&|episode| ratio(episode.steps() as f64, episode.steps_left as f64)),
            success_rate: mean(&|episode| if episode.achievement.success { 1.0 } else { 0.0 }),
            measures: measures(finished),
            tracking_error: TrackingError::of(finished),
            head_height: per_step(&|episode| episode.head_heights),
            reward_terms: spec
                .reward_terms
                .iter()
                .zip(0..MAX_REWARD_TERMS)
                .map(|(name, term)| (name.clone(), per_step(&|episode| episode.returns[term])))
                .collect(),
        }
    }
}

/// The mean of each measure over the episodes that have it.
fn measures(finished: &[&Finished]) -> BTreeMap<String, f64> {
    let mut sums: BTreeMap<&str, (f64, f64)> = BTreeMap::new();
    for (name, value) in finished.iter().flat_map(|episode| episode.achievement.measures()) {
        let (sum, count) = sums.entry(name).or_default();
        (*sum, *count) = (*sum + value, *count + 1.0);
    }
    sums.into_iter().map(|(name, (sum, count))| (name.to_owned(), ratio(sum, count))).collect()
}

/// A quotient, 0 when the divisor is 0: JSON has no NaN.
fn ratio(sum: f64, count: f64) -> f64 {
    if count > 0.0 { sum / count } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec() -> TaskSpec {
        TaskSpec {
            proprioception: 1,
            task: 1,
            action: 1,
            reward_terms: vec!["pose".into(), "velocity".into()],
            image: 0,
            clips: vec!["walk".into(), "run".into(), "unused".into()],
            tasks: vec![TaskPart { name: "tracking".into(), observation: 1, clips: 3, max_reward: 1.45 }],
        }
    }

    fn episode(clip: usize, steps_left: usize, steps: usize, pose: f64, velocity: f64) -> Finished {
        let mut returns = [0.0; MAX_REWARD_TERMS];
        returns[..2].copy_from_slice(&[pose, velocity]);
        // 1 m in a short episode and 2 m in a long one.
        let head_heights = if steps < 10 { 1.0 } else { 2.0 } * steps as f64;
        let outcome = if steps == steps_left { Outcome::Truncated } else { Outcome::Terminated };
        // 2 cm a step, of which 1 cm is the root's, and equal velocities.
        let (position, local_position) = (0.02 * steps as f64, 0.01 * steps as f64);
        let tracking = TrackingSums { position, local_position, velocity: 0.0, steps };
        let rewards = vec![0.0; steps];
        let achievement = Achievement::new(outcome == Outcome::Truncated);
        Finished {
            number: 0,
            clip,
            start: 0,
            steps_left,
            rewards,
            returns,
            head_heights,
            tracking,
            achievement,
            outcome,
        }
    }

    #[test]
    fn the_formulas_by_hand() {
        let finished = [episode(0, 10, 5, 2.9, 1.45), episode(0, 20, 20, 14.5, 14.5), episode(1, 4, 4, 0.0, 5.8)];
        let report = Report::new(&spec(), &finished, &RolloutSettings::default());
        let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-12, "{a} is not {b}");
        assert_eq!(report.clips.len(), 2, "a clip without an episode has no row");

        let walk = &report.clips[0];
        close(walk.return_mean, f64::midpoint(4.35, 29.0));
        // 4.35 / (1.45 × 10) = 0.3 and 29 / (1.45 × 20) = 1: a fall half-way loses the other half.
        close(walk.normalised_reward, 0.65);
        // (3 + 20) / 25: steps after a fall do not count.
        close(walk.reward_per_step, 23.0 / 25.0);
        close(walk.fraction_survived, 0.75);
        close(walk.length_mean, 12.5);
        // (5 × 1 m + 20 × 2 m) / 25: over steps, not episodes.
        close(walk.head_height, 1.8);
        close(walk.success_rate, 0.5);
        let error = walk.tracking_error.unwrap();
        close(error.position_mm, 20.0);
        close(error.local_position_mm, 10.0);
        close(error.velocity_mm_per_step, 0.0);
        close(walk.reward_terms["pose"], (2.9 + 14.5) / 25.0);
        close(walk.reward_terms["velocity"], (1.45 + 14.5) / 25.0);

        assert_eq!((report.overall.clip.as_str(), report.overall.episodes), ("overall", 3));
        close(report.overall.normalised_reward, (0.3 + 1.0 + 1.0) / 3.0);
    }

    #[test]
    fn each_task_has_a_row_relative_to_its_own_largest_reward() {
        let mut spec = spec();
        spec.tasks[0].clips = 2;
        spec.tasks.push(TaskPart { name: "get-up".into(), max_reward: 1.0, clips: 1, ..spec.tasks[0].clone() });
        let finished = [episode(0, 10, 10, 14.5, 0.0), episode(1, 10, 10, 0.0, 0.0), episode(2, 10, 10, 5.0, 0.0)];
        let report = Report::new(&spec, &finished, &RolloutSettings::default());
        let rows: Vec<_> =
            report.tasks.iter().map(|row| (row.clip.as_str(), row.episodes, row.normalised_reward)).collect();
        assert_eq!(rows, [("tracking", 2, 0.5), ("get-up", 1, 0.5)]);
        assert!(
            Report::new(&self::spec(), &finished[..2], &RolloutSettings::default()).tasks.is_empty(),
            "a single task has no rows of tasks"
        );
    }

    #[test]
    fn a_report_without_episodes_has_no_nan() {
        let report = Report::new(&spec(), &[], &RolloutSettings::default());
        let json = serde_json::to_string(&report).unwrap();
        assert_eq!(serde_json::from_str::<Report>(&json).unwrap(), report);
    }

    /// An episode of clip `clip` that held so many targets.
    fn with_targets(clip: usize, targets: f64) -> Finished {
        let achievement = Achievement::new(targets > 0.0).measuring(&["targets"], [targets]);
        Finished { achievement, ..episode(clip, 10, 10, 0.0, 0.0) }
    }

    #[test]
    fn success_and_measures_are_the_tasks_own() {
        // All last to the end, but only those with a target are a success.
        let finished = [with_targets(0, 3.0), with_targets(0, 0.0), with_targets(1, 0.0), episode(2, 10, 10, 0.0, 0.0)];
        let report = Report::new(&spec(), &finished, &RolloutSettings::default());
        let rates: Vec<f64> = report.clips.iter().map(|clip| clip.success_rate).collect();
        assert_eq!(rates, [0.5, 0.0, 1.0]);
        let targets: Vec<_> = report.clips.iter().map(|clip| clip.measures.get("targets").copied()).collect();
        assert_eq!(targets, [Some(1.5), Some(0.0), None]);
        assert_eq!(report.overall.measures["targets"], 1.0, "over the episodes that have the measure");
        let table = report.to_string();
        let header: Vec<&str> = table.lines().next().unwrap().split("  ").filter(|cell| !cell.is_empty()).collect();
        let row: Vec<&str> = table.lines().nth(1).unwrap().split("  ").filter(|cell| !cell.is_empty()).collect();
        let cell = |name: &str| row[header.iter().position(|column| column.trim() == name).unwrap()].trim();
        assert_eq!((cell("success"), cell("targets")), ("0.500", "1.50"));
    }

    #[test]
    fn a_report_of_an_earlier_release_is_read() {
        let report = Report::new(&spec(), &[episode(0, 10, 10, 0.0, 0.0)], &RolloutSettings::default());
        let json = serde_json::to_value(&report).unwrap();
        assert!(json["overall"].get("measures").is_none(), "a task without measures writes none");
        assert_eq!(serde_json::from_value::<Report>(json).unwrap(), report);
    }
}
