//! What a rank counts between two lines of metrics. That of all ranks adds up to the run's.

use std::ops::AddAssign;

use comic_experiment::TaskSpec;
use comic_proto::Field;
use comic_proto::v1::{EpisodeEnd, EpisodeStatistics, UnrollHeader};
use comic_replay::Batch;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// Sums since the last line.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Window {
    pub(super) episodes: Episodes,
    /// Task by task.
    pub(super) tasks: Vec<TaskWindow>,
    /// Of each reward term.
    pub(super) returns: Vec<f64>,
    pub(super) unrolls: u64,
    pub(super) age: u64,
}

/// Sums over episodes.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Episodes {
    count: u64,
    pub(super) steps: u64,
    diverged: u64,
    total: f64,
    /// Of return / the most that a step pays.
    share: f64,
    /// Of return / (the most it could have paid).
    normalised: f64,
    /// Of the share of the clip that was survived.
    survived: f64,
    /// Of the head's heights, m, over the steps where they are known.
    head_heights: f64,
    head_steps: u64,
}

/// Sums over the unrolls of one task.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct TaskWindow {
    pub(super) episodes: Episodes,
    pub(super) unrolls: u64,
    pub(super) rows: Rows,
}

/// The rows of one task's unrolls.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rows {
    /// Rows in all.
    pub rows: u64,
    /// Rows with a transition.
    pub environment_steps: u64,
    /// Rows that repeat an observation, because the next episode belongs to another task.
    pub padding: u64,
}

impl Rows {
    /// The rows of each of so many tasks in a batch.
    pub(crate) fn of(batch: &Batch, tasks: usize) -> Vec<Self> {
        let length = batch.layout.shape().length.max(1);
        let mut counted = vec![Self::default(); tasks];
        let firsts = batch.f32(Field::First).chunks_exact(length + 1);
        for ((valid, first), task) in batch.f32(Field::Valid).chunks_exact(length).zip(firsts).zip(batch.tasks()) {
            let environment_steps = valid.iter().filter(|valid| **valid > 0.5).count() as u64;
            // Rows that begin an episode without a step.
            let padding = valid.iter().zip(first).filter(|(valid, first)| **valid < 0.5 && **first > 0.5).count();
            if let Some(counted) = counted.get_mut(task) {
                *counted += Self { rows: length as u64, environment_steps, padding: padding as u64 };
            }
        }
        counted
    }
}

impl AddAssign for Rows {
    fn add_assign(&mut self, other: Self) {
        self.rows += other.rows;
        self.environment_steps += other.environment_steps;
        self.padding += other.padding;
    }
}

impl Episodes {
    pub(super) fn add(&mut self, episode: &EpisodeStatistics, max_reward: f64) {
        let possible = f64::from(episode.steps_left_at_start.max(1));
        let total: f64 = episode.returns.iter().map(|term| f64::from(*term)).sum();
        self.count += 1;
        self.steps += u64::from(episode.steps);
        self.diverged += u64::from(episode.end == EpisodeEnd::Diverged as i32);
        self.total += total;
        self.share += total / max_reward;
        self.normalised += total / (max_reward * possible);
        self.survived += f64::from(episode.steps) / possible;
        if let Some(height) = episode.head_height {
            self.head_heights += f64::from(height) * f64::from(episode.steps);
            self.head_steps += u64::from(episode.steps);
        }
    }

    pub(super) fn entries(&self) -> [(&'static str, Value); 8] {
        [
            ("episodes", json!(self.count)),
            ("diverged", json!(self.diverged)),
            ("episode_length", per(self.steps as f64, self.count)),
            ("episode_return", per(self.total, self.count)),
            ("reward_per_step", per(self.share, self.steps)),
            ("normalised_reward", per(self.normalised, self.count)),
            ("fraction_survived", per(self.survived, self.count)),
            ("head_height", per(self.head_heights, self.head_steps)),
        ]
    }
}

impl AddAssign<&Self> for Episodes {
    fn add_assign(&mut self, other: &Self) {
        self.count += other.count;
        self.steps += other.steps;
        self.diverged += other.diverged;
        self.total += other.total;
        self.share += other.share;
        self.normalised += other.normalised;
        self.survived += other.survived;
        self.head_heights += other.head_heights;
        self.head_steps += other.head_steps;
    }
}

impl AddAssign<&Self> for TaskWindow {
    fn add_assign(&mut self, other: &Self) {
        self.episodes += &other.episodes;
        self.unrolls += other.unrolls;
        self.rows += other.rows;
    }
}

/// The mean of nothing is absent, not 0.
pub(super) fn per(value: f64, count: u64) -> Value {
    if count == 0 { Value::Null } else { json!(value / count as f64) }
}

impl Window {
    /// Counts the rows of a batch and returns the counts of each task.
    pub fn count_rows(&mut self, batch: &Batch, spec: &TaskSpec) -> Vec<Rows> {
        let counted = Rows::of(batch, spec.tasks.len());
        self.tasks.resize(spec.tasks.len(), TaskWindow::default());
        for task in batch.tasks() {
            if let Some(window) = self.tasks.get_mut(task) {
                window.unrolls += 1;
            }
        }
        for (window, rows) in self.tasks.iter_mut().zip(&counted) {
            window.rows += *rows;
        }
        counted
    }

    /// Counts a batch's episodes, and the age of its unrolls where `version` is the newest.
    pub fn count_episodes(&mut self, headers: &[UnrollHeader], version: u64, spec: &TaskSpec) {
        self.returns.resize(spec.reward_terms.len(), 0.0);
        self.tasks.resize(spec.tasks.len(), TaskWindow::default());
        for header in headers {
            self.unrolls += 1;
            self.age += version.saturating_sub(header.version);
            let task = header.task as usize;
            let max_reward = spec.tasks.get(task).map_or(1.0, |task| task.max_reward);
            for episode in &header.episodes {
                self.episodes.add(episode, max_reward);
                if let Some(task) = self.tasks.get_mut(task) {
                    task.episodes.add(episode, max_reward);
                }
                for (sum, value) in self.returns.iter_mut().zip(&episode.returns) {
                    *sum += f64::from(*value);
                }
            }
        }
    }

    /// Whether no unroll was counted.
    pub(super) fn is_empty(&self) -> bool {
        self.unrolls == 0 && self.tasks.iter().all(|task| task.unrolls == 0)
    }
}

impl AddAssign<&Self> for Window {
    fn add_assign(&mut self, other: &Self) {
        self.episodes += &other.episodes;
        self.tasks.resize(self.tasks.len().max(other.tasks.len()), TaskWindow::default());
        self.tasks.iter_mut().zip(&other.tasks).for_each(|(task, other)| *task += other);
        self.returns.resize(self.returns.len().max(other.returns.len()), 0.0);
        self.returns.iter_mut().zip(&other.returns).for_each(|(sum, other)| *sum += other);
        self.unrolls += other.unrolls;
        self.age += other.age;
    }
}

#[cfg(test)]
mod tests {
    use serde_json::Map;

    use super::*;

    #[test]
    fn the_heads_height_is_the_mean_over_the_steps_where_it_is_known() {
        let mut episodes = Episodes::default();
        for (steps, head_height) in [(30, Some(1.0)), (10, Some(0.2)), (60, None)] {
            episodes.add(&EpisodeStatistics { steps, head_height, ..EpisodeStatistics::default() }, 1.0);
        }
        let entries: Map<String, Value> =
            episodes.entries().map(|(name, value)| (name.to_string(), value)).into_iter().collect();
        let height = entries["head_height"].as_f64().unwrap();
        assert!((height - 0.8).abs() < 1e-6, "(30 · 1.0 + 10 · 0.2) / 40 is not {height}");
    }
}
