//! The metrics of a run for people: one JSON line every few seconds in `RUN/metrics.jsonl` and for TensorBoard. The newest
//! line is also the status.

use std::ops::AddAssign;
use std::path::{Path, PathBuf};
use std::time::Instant;

use comic_experiment::{Experiment, TaskPart, TaskSpec};
use comic_proto::Field;
use comic_proto::v1::{EpisodeEnd, EpisodeStatistics, UnrollHeader};
use comic_replay::{AccountingByTask, Batch};
use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::algorithm::replay::ReplayReport;
use crate::error::{Error, Result};
use crate::observe::evaluation::Evaluation;
use crate::observe::evaluation_writer::EvaluationWriter;
use crate::observe::page::{Page, State};
use crate::observe::tensorboard::Events;
use crate::observe::whole::Whole;

/// Sums since the last line.
#[derive(Debug, Default)]
struct Window {
    episodes: Episodes,
    /// Task by task.
    tasks: Vec<TaskWindow>,
    returns: Vec<f64>,
    unrolls: u64,
    age: u64,
    updates: u64,
    updates_skipped: u64,
}

/// Sums over episodes.
#[derive(Clone, Debug, Default)]
struct Episodes {
    count: u64,
    steps: u64,
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
#[derive(Clone, Debug, Default)]
struct TaskWindow {
    episodes: Episodes,
    unrolls: u64,
    rows: Rows,
}

/// The rows of one task's unrolls.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Rows {
    /// Rows in all.
    pub rows: u64,
    /// Rows with a transition.
    pub environment_steps: u64,
    /// Rows that repeat an observation, because the next episode belongs to another task.
    pub padding: u64,
}

impl AddAssign for Rows {
    fn add_assign(&mut self, other: Self) {
        self.rows += other.rows;
        self.environment_steps += other.environment_steps;
        self.padding += other.padding;
    }
}

impl Episodes {
    fn add(&mut self, episode: &EpisodeStatistics, max_reward: f64) {
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

    fn entries(&self) -> [(&'static str, Value); 8] {
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

/// The mean of nothing is absent, not 0.
fn per(value: f64, count: u64) -> Value {
    if count == 0 { Value::Null } else { json!(value / count as f64) }
}

/// Collects and writes metrics.
#[derive(Debug)]
pub struct MetricsFile {
    experiment: Experiment,
    spec: TaskSpec,
    run: PathBuf,
    file: Whole,
    /// `None` if the file could not be opened.
    events: Option<Events>,
    evaluations: EvaluationWriter,
    page: Page,
    window: Window,
    since: Instant,
    /// The accounting of the last line.
    accounting: AccountingByTask,
}

/// Seconds since the process started in which one side waited for the other.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Waited {
    /// The trainer for unrolls.
    pub learner: f64,
    /// Unrolls for a place in a batch, each for itself.
    pub unrolls: f64,
}

/// How far the run is, for the beginning of a line.
#[derive(Clone, Copy, Debug, Default)]
pub struct Position {
    /// Wall-clock seconds since the first unroll, those of earlier learner epochs included.
    pub seconds: f64,
    /// Environment steps trained on, over the whole run.
    pub environment_steps: u64,
    /// Batches trained on, over the whole run.
    pub updates: u64,
    /// Gradient steps, over the whole run.
    pub gradient_steps: u64,
    /// Newest published version.
    pub version: u64,
    /// The learner epoch.
    pub epoch: u64,
    /// How long each side has waited.
    pub waited: Waited,
}

impl MetricsFile {
    /// Appends to `RUN/metrics.jsonl`.
    ///
    /// # Errors
    /// When the file cannot be opened.
    pub fn open(run: &Path, experiment: &Experiment, spec: &TaskSpec) -> Result<Self> {
        let file = run.join("metrics.jsonl");
        Ok(Self {
            page: Page::open(run, experiment)?,
            experiment: experiment.clone(),
            spec: spec.clone(),
            run: run.to_path_buf(),
            file: Whole::open_lines(&file).map_err(Error::file("open", &file))?,
            events: None,
            evaluations: EvaluationWriter::new(run),
            window: Window::default(),
            since: Instant::now(),
            accounting: AccountingByTask::default(),
        })
    }

    /// Begins a learner epoch after so many environment steps, with this accounting. Without TensorBoard's file the epoch
    /// continues.
    pub fn begin(&mut self, epoch: u64, environment_steps: u64, accounting: AccountingByTask) {
        self.accounting = accounting;
        let begun = Events::begin(&self.run, epoch, environment_steps);
        self.events = begun
            .map_err(|error| tracing::error!("nothing is written for TensorBoard: {}", comic_proto::chain(&error)))
            .ok();
        let written = self.events.as_mut().map(|events| events.write_experiment(environment_steps, &self.experiment));
        if let Some(Err(error)) = written {
            tracing::error!("TensorBoard's file lacks the experiment: {}", comic_proto::chain(&error));
        }
    }

    /// Writes the page of a run that goes on, if the last one is a minute old. A learner that waits for actors writes no lines, but
    /// this.
    pub(crate) fn write_page_when_due(&mut self) {
        if self.page.is_due() {
            self.page.write(State::Running, self.evaluations.summary());
        }
    }

    /// Ends the learner epoch: the page shows this state from now on.
    pub(crate) fn end(&mut self, state: State) {
        self.page.write(state, self.evaluations.summary());
    }

    /// Seconds since the last line.
    pub fn elapsed(&self) -> f64 {
        self.since.elapsed().as_secs_f64()
    }

    /// Whether a line would differ from the last one: without actors a learner writes none.
    pub fn has_news(&self, accounting: &AccountingByTask) -> bool {
        self.window.unrolls > 0
            || self.window.tasks.iter().any(|task| task.unrolls > 0)
            || self.accounting != *accounting
    }

    /// Appends evaluations of actors to `RUN/evaluations.jsonl`, writes their films to `RUN/films/`, and shows both in
    /// TensorBoard and on the page. If the disk refuses, the error is logged, and training continues.
    pub fn keep_evaluations(&mut self, evaluations: &[Evaluation]) {
        evaluations.iter().for_each(|evaluation| self.evaluations.keep(evaluation, self.events.as_mut()));
        if !evaluations.is_empty() {
            self.page.write(State::Running, self.evaluations.summary());
        }
    }

    /// Counts the rows of a batch and returns the counts of each task.
    pub fn count_rows(&mut self, batch: &Batch) -> Vec<Rows> {
        let length = batch.layout.shape().length.max(1);
        self.window.tasks.resize(self.spec.tasks.len(), TaskWindow::default());
        let mut counted = vec![Rows::default(); self.spec.tasks.len()];
        let firsts = batch.f32(Field::First).chunks_exact(length + 1);
        for ((valid, first), task) in batch.f32(Field::Valid).chunks_exact(length).zip(firsts).zip(batch.tasks()) {
            let environment_steps = valid.iter().filter(|valid| **valid > 0.5).count() as u64;
            // Rows that begin an episode without a step.
            let padding = valid.iter().zip(first).filter(|(valid, first)| **valid < 0.5 && **first > 0.5).count();
            if let (Some(window), Some(counted)) = (self.window.tasks.get_mut(task), counted.get_mut(task)) {
                window.unrolls += 1;
                *counted += Rows { rows: length as u64, environment_steps, padding: padding as u64 };
            }
        }
        for (window, rows) in self.window.tasks.iter_mut().zip(&counted) {
            window.rows += *rows;
        }
        counted
    }

    /// Counts a batch that V-MPO trained on.
    pub fn count_update(&mut self) {
        self.window.updates += 1;
    }

    /// Counts gradient steps that were skipped.
    pub fn count_skipped(&mut self, steps: u64) {
        self.window.updates_skipped += steps;
    }

    /// Counts a batch's episodes, and the age of its unrolls where `version` is the newest.
    pub fn count_episodes(&mut self, headers: &[UnrollHeader], version: u64) {
        let window = &mut self.window;
        window.returns.resize(self.spec.reward_terms.len(), 0.0);
        window.tasks.resize(self.spec.tasks.len(), TaskWindow::default());
        for header in headers {
            window.unrolls += 1;
            window.age += version.saturating_sub(header.version);
            let task = header.task as usize;
            let max_reward = self.spec.tasks.get(task).map_or(1.0, |task| task.max_reward);
            for episode in &header.episodes {
                window.episodes.add(episode, max_reward);
                if let Some(task) = window.tasks.get_mut(task) {
                    task.episodes.add(episode, max_reward);
                }
                for (sum, value) in window.returns.iter_mut().zip(&episode.returns) {
                    *sum += f64::from(*value);
                }
            }
        }
    }

    /// Writes the line, starts a new window, and returns the line for the status. If the disk refuses, the error is logged, and
    /// training continues.
    pub fn write(
        &mut self,
        position: Position,
        accounting: AccountingByTask,
        losses: Map<String, Value>,
        replay: Option<ReplayReport>,
    ) -> String {
        let mut line = self.line(position, &accounting, losses);
        if let Some(replay) = replay {
            line["replay"] = json!(replay);
        }
        self.window = Window::default();
        self.since = Instant::now();
        self.accounting = accounting;
        if let Some(Err(error)) = self.events.as_mut().map(|events| events.write(&line)) {
            tracing::error!("TensorBoard's file lacks a line: {error}");
        }
        self.page.add(&line);
        let line = line.to_string();
        if let Err(error) = self.file.append(format!("{line}\n").as_bytes()) {
            tracing::error!("metrics.jsonl lacks a line: {error}");
        }
        line
    }

    fn line(&self, position: Position, accounting: &AccountingByTask, losses: Map<String, Value>) -> Value {
        let window = &self.window;
        let seconds = self.elapsed().max(1e-9);
        let environment_steps: u64 = window.tasks.iter().map(|task| task.rows.environment_steps).sum();
        let named = self.spec.reward_terms.iter().zip(&window.returns);
        let terms: Map<String, Value> =
            named.map(|(name, sum)| (name.clone(), per(*sum, window.episodes.steps))).collect();
        let mut line = json!({
            "seconds": position.seconds,
            "learner_epoch": position.epoch,
            "environment_steps": position.environment_steps,
            "updates": position.updates,
            "gradient_steps": position.gradient_steps,
            "version": position.version,
            "updates_skipped": window.updates_skipped,
            "steps_per_second": environment_steps as f64 / seconds,
            "updates_per_second": window.updates as f64 / seconds,
            "unroll_age": per(window.age as f64, window.unrolls),
            "reward_terms": terms,
            "losses": losses,
            "accounting": accounting.all,
            "waited": position.waited,
        });
        for (name, value) in window.episodes.entries() {
            line[name] = value;
        }
        if self.spec.tasks.len() > 1 {
            line["tasks"] = self.by_task(accounting).into();
        }
        line
    }

    /// The entries of each task, by its name.
    fn by_task(&self, accounting: &AccountingByTask) -> Map<String, Value> {
        let entries = |(index, task): (usize, &TaskPart)| {
            // Without an update since the last line, the accounting may have changed all the same.
            let window = self.window.tasks.get(index).cloned().unwrap_or_default();
            let mut entries: Map<String, Value> =
                window.episodes.entries().map(|(name, value)| (name.to_string(), value)).into_iter().collect();
            let Rows { rows, environment_steps, padding } = window.rows;
            entries.insert("unrolls".into(), json!(window.unrolls));
            entries.insert("environment_steps".into(), json!(environment_steps));
            entries.insert("padding_share".into(), per(padding as f64, rows));
            entries.insert("accounting".into(), json!(accounting.tasks.get(&task.name)));
            (task.name.clone(), Value::Object(entries))
        };
        self.spec.tasks.iter().enumerate().map(entries).collect()
    }
}

#[cfg(test)]
mod tests {
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

    #[test]
    fn a_full_disk_loses_lines_and_nothing_else() {
        let directory = tempfile::tempdir().unwrap();
        // A device that is always full.
        std::os::unix::fs::symlink("/dev/full", directory.path().join("metrics.jsonl")).unwrap();
        std::os::unix::fs::symlink("/dev/full", directory.path().join("evaluations.jsonl")).unwrap();
        let experiment = Experiment::default();
        let spec = TaskSpec::new(&experiment, vec!["walk".into()]).unwrap();
        let mut metrics = MetricsFile::open(directory.path(), &experiment, &spec).unwrap();
        let position = Position { updates: 3, ..Position::default() };
        for _ in 0..2 {
            let line = metrics.write(position, AccountingByTask::default(), Map::new(), None);
            assert!(line.contains("\"updates\":3"), "{line}");
        }
        metrics.keep_evaluations(&[Evaluation { epoch: 5, updates: 3, json: "{}".into(), ..Evaluation::default() }]);
    }
}
