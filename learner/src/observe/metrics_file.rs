//! The metrics of a run for people: one JSON line every few seconds in `RUN/metrics.jsonl` and for TensorBoard. The newest
//! line is also the status.

use std::path::{Path, PathBuf};
use std::time::Instant;

use comic_experiment::{Experiment, TaskPart, TaskSpec};
use comic_replay::AccountingByTask;
use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::algorithm::replay::ReplayReport;
use crate::error::{Error, Result};
use crate::observe::evaluation::Evaluation;
use crate::observe::evaluation_writer::EvaluationWriter;
use crate::observe::page::{Page, State};
use crate::observe::tensorboard::Events;
use crate::observe::whole::Whole;
use crate::observe::window::{Rows, Window, per};

/// Writes metrics.
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
    /// Batches trained on since the last line, and gradient steps that were skipped.
    updates: u64,
    updates_skipped: u64,
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
            updates: 0,
            updates_skipped: 0,
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
    pub fn has_news(&self, window: &Window, accounting: &AccountingByTask) -> bool {
        !window.is_empty() || self.accounting != *accounting
    }

    /// Appends evaluations of actors to `RUN/evaluations.jsonl`, writes their films to `RUN/films/`, and shows both in
    /// TensorBoard and on the page. If the disk refuses, the error is logged, and training continues.
    pub fn keep_evaluations(&mut self, evaluations: &[Evaluation]) {
        evaluations.iter().for_each(|evaluation| self.evaluations.keep(evaluation, self.events.as_mut()));
        if !evaluations.is_empty() {
            self.page.write(State::Running, self.evaluations.summary());
        }
    }

    /// Counts a batch that V-MPO trained on.
    pub fn count_update(&mut self) {
        self.updates += 1;
    }

    /// Counts gradient steps that were skipped.
    pub fn count_skipped(&mut self, steps: u64) {
        self.updates_skipped += steps;
    }

    /// Writes the line of what was counted since the last one, and returns it for the status. If the disk refuses, the error is logged, and
    /// training continues.
    pub fn write(
        &mut self,
        position: Position,
        window: &Window,
        accounting: AccountingByTask,
        losses: Map<String, Value>,
        replay: Option<ReplayReport>,
    ) -> String {
        let mut line = self.line(position, window, &accounting, losses);
        if let Some(replay) = replay {
            line["replay"] = json!(replay);
        }
        (self.updates, self.updates_skipped) = (0, 0);
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

    fn line(
        &self,
        position: Position,
        window: &Window,
        accounting: &AccountingByTask,
        losses: Map<String, Value>,
    ) -> Value {
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
            "updates_skipped": self.updates_skipped,
            "steps_per_second": environment_steps as f64 / seconds,
            "updates_per_second": self.updates as f64 / seconds,
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
            line["tasks"] = self.by_task(window, accounting).into();
        }
        line
    }

    /// The entries of each task, by its name.
    fn by_task(&self, window: &Window, accounting: &AccountingByTask) -> Map<String, Value> {
        let entries = |(index, task): (usize, &TaskPart)| {
            // Without an update since the last line, the accounting may have changed all the same.
            let window = window.tasks.get(index).cloned().unwrap_or_default();
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
            let line = metrics.write(position, &Window::default(), AccountingByTask::default(), Map::new(), None);
            assert!(line.contains("\"updates\":3"), "{line}");
        }
        metrics.keep_evaluations(&[Evaluation { epoch: 5, updates: 3, json: "{}".into(), ..Evaluation::default() }]);
    }
}
