//! What training tells people, Prometheus and the service.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use comic_experiment::{Experiment, TaskSpec};
use comic_proto::v1::{EpisodeEnd, UnrollHeader};
use comic_replay::{AccountingByTask, Batch};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use crate::algorithm::loss_report::{LossValues, Losses};
use crate::algorithm::replay::ReplayReport;
use crate::checkpoint::Evaluated;
use crate::checkpoint::progress::Progress;
use crate::error::Result;
use crate::observe::evaluation::Evaluation;
use crate::observe::metrics_file::{MetricsFile, Position, Waited};
use crate::observe::page::State;
use crate::observe::prometheus::Prometheus;
use crate::observe::window::Window;
use crate::service::TrainerHandle;
use crate::train::parts::Ending;

/// Counters, metric lines, and evaluations that came in.
#[derive(Debug)]
pub(super) struct Reports {
    /// What this rank counted since the last line.
    window: Window,
    /// What is written; only rank 0 writes.
    metrics: Option<MetricsFile>,
    /// Shows the newest metrics, and collects the evaluations that actors report.
    service: TrainerHandle,
    prometheus: Arc<Prometheus>,
    /// Seconds between two lines.
    interval: f64,
    spec: TaskSpec,
    /// The newest finite losses, as a line shows them.
    losses: Map<String, Value>,
    /// The last update's losses, if reading them at once would mean to wait for the device.
    deferred: Option<Losses>,
    /// The newest state of the replay, if there is one.
    replay: Option<ReplayReport>,
    waited: Waited,
}

/// What one rank counted.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Counted {
    window: Window,
    accounting: AccountingByTask,
}

impl Reports {
    /// Opens the metrics of `run`, if this rank writes any.
    ///
    /// # Errors
    /// When their file cannot be opened.
    pub(super) fn open(
        run: Option<&Path>,
        experiment: &Experiment,
        spec: &TaskSpec,
        service: TrainerHandle,
    ) -> Result<Self> {
        Ok(Self {
            window: Window::default(),
            metrics: run.map(|run| MetricsFile::open(run, experiment, spec)).transpose()?,
            prometheus: service.prometheus.clone(),
            service,
            interval: experiment.learner.metrics_seconds,
            spec: spec.clone(),
            losses: Map::new(),
            deferred: None,
            replay: None,
            waited: Waited::default(),
        })
    }

    /// Begins a learner epoch at this progress.
    pub(super) fn begin(&mut self, progress: &Progress, accounting: AccountingByTask) {
        if let Some(metrics) = &mut self.metrics {
            metrics.begin(progress.epoch, progress.environment_steps, accounting);
        }
    }

    /// Ends the learner epoch.
    pub(super) fn end(&mut self, ended: &Result<Ending>) {
        let state = match ended {
            Ok(Ending::Budget) => State::Over,
            Ok(Ending::Stopped) => State::Stopped,
            Err(_) => State::Failed,
        };
        if let Some(metrics) = &mut self.metrics {
            metrics.end(state);
        }
    }

    /// Writes the run's page if the last one is a minute old.
    pub(super) fn write_page_when_due(&mut self) {
        if let Some(metrics) = &mut self.metrics {
            metrics.write_page_when_due();
        }
    }

    /// Counts the rows and episodes of a batch that was used.
    pub(super) fn count_rows(&mut self, batch: &Batch) {
        for (rows, task) in self.window.count_rows(batch, &self.spec).into_iter().zip(&self.spec.tasks) {
            self.prometheus.count_rows(&task.name, rows);
        }
        for UnrollHeader { actor, incarnation, sequence, version, .. } in batch.headers() {
            tracing::trace!(actor, incarnation = format_args!("{incarnation:016x}"), sequence, version, "trained on");
        }
        let episodes = batch.headers().iter().flat_map(|header| &header.episodes);
        let diverged = episodes.filter(|episode| episode.end() == EpisodeEnd::Diverged).count();
        self.prometheus.episodes_diverged.inc_by(diverged as u64);
    }

    /// Counts an update of so many gradient steps on a batch whose parameters were `version`; the duration is counted by
    /// [`count_duration`](Self::count_duration).
    pub(super) fn count_update(&mut self, batch: &Batch, version: u64, steps: u64) {
        self.prometheus.gradient_steps.inc_by(steps);
        self.window.count_episodes(batch.headers(), version, &self.spec);
        if let Some(metrics) = &mut self.metrics {
            metrics.count_update();
        }
    }

    /// Counts the duration of an update on unrolls of these ages, in versions.
    pub(super) fn count_duration(&self, duration: Duration, ages: Vec<u64>) {
        self.prometheus.count_update(duration, ages);
    }

    /// Counts the programs that the device has compiled so far.
    pub(super) fn count_compilations(&self, compilations: u64) {
        self.prometheus.count_compilations(compilations);
    }

    /// Shows the state of the replay.
    pub(super) fn set_replay(&mut self, replay: ReplayReport) {
        self.prometheus.set_replay(&replay);
        self.replay = Some(replay);
    }

    /// Shows how long trainer and unrolls have waited since the process started.
    pub(super) fn set_waited(&mut self, waited: Waited) {
        self.prometheus.set_waited(waited);
        self.waited = waited;
    }

    /// Counts gradient steps that were skipped.
    pub(super) fn count_skipped(&mut self, skipped: u64) {
        if let Some(metrics) = &mut self.metrics {
            metrics.count_skipped(skipped);
        }
        self.prometheus.updates_skipped.inc_by(skipped);
    }

    /// Counts a return to the last good state.
    pub(super) fn count_restore(&self) {
        self.prometheus.restores.inc();
    }

    /// Keeps losses to be read later.
    pub(super) fn defer(&mut self, losses: Option<Losses>) {
        self.deferred = losses;
    }

    /// The losses to be read later.
    pub(super) fn take_deferred(&mut self) -> Option<Losses> {
        self.deferred.take()
    }

    /// Keeps the newest losses for the metrics, if they are finite.
    pub(super) fn keep_losses(&mut self, losses: &LossValues) {
        if !losses.is_finite() {
            return;
        }
        self.losses = losses.entries().iter().map(|(name, value)| ((*name).to_string(), json!(value))).collect();
        let tasks = &self.spec.tasks;
        if tasks.len() > 1 && losses.temperatures.len() == tasks.len() {
            let named =
                tasks.iter().map(|task| task.name.clone()).zip(losses.temperatures.iter().map(|eta| json!(eta)));
            self.losses.insert("temperatures".to_string(), Value::Object(named.collect()));
        }
    }

    /// Whether the last line is old enough for another one.
    pub(super) fn are_due(&self) -> bool {
        self.metrics.as_ref().is_some_and(|metrics| metrics.elapsed() >= self.interval)
    }

    /// Writes the evaluations that actors reported since the last time, and returns what they say of checkpoints. Those of a
    /// place that the run has not reached are left out: they would hide the others.
    pub(super) fn take_evaluations(&mut self, progress: &Progress) -> Vec<Evaluated> {
        let mut evaluations = self.service.take_evaluations();
        evaluations.retain(|evaluation| {
            let possible = evaluation.is_before(progress);
            if !possible {
                let &Evaluation { epoch, updates, environment_steps, seconds, .. } = evaluation;
                tracing::warn!(
                    epoch,
                    updates,
                    environment_steps,
                    seconds,
                    "an evaluation is left out, because this run has no such checkpoint yet: report one of this run"
                );
            }
            possible
        });
        if let Some(metrics) = &mut self.metrics {
            metrics.keep_evaluations(&evaluations);
        }
        evaluations.iter().filter_map(|evaluation| evaluation.evaluated()).collect()
    }

    /// What this rank counted since the last time.
    pub(super) fn take_counted(&mut self, accounting: AccountingByTask) -> Counted {
        Counted { window: std::mem::take(&mut self.window), accounting }
    }

    /// Writes a line of metrics of what all ranks `counted`, and shows it as the run's status. Leaves it out if it says nothing new,
    /// unless it is the `last` one.
    pub(super) fn write(&mut self, progress: &Progress, counted: Vec<Counted>, last: bool) {
        let Some(metrics) = &mut self.metrics else { return };
        let (mut window, mut accounting) = (Window::default(), AccountingByTask::default());
        for counted in counted {
            window += &counted.window;
            accounting += counted.accounting;
        }
        if !last && !metrics.has_news(&window, &accounting) {
            return;
        }
        let position = Position {
            seconds: progress.seconds,
            environment_steps: progress.environment_steps,
            updates: progress.updates,
            gradient_steps: progress.gradient_steps,
            version: progress.version,
            epoch: progress.epoch,
            waited: self.waited,
        };
        let line = metrics.write(position, &window, accounting, self.losses.clone(), self.replay);
        tracing::info!(target: "metrics", "{line}");
        self.service.set_metrics(line);
    }
}
