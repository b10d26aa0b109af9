//! What training tells people, Prometheus and the service.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use comic_experiment::{Experiment, TaskSpec};
use comic_proto::v1::{EpisodeEnd, UnrollHeader};
use comic_replay::{AccountingByTask, Batch};
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
use crate::service::TrainerHandle;
use crate::train::parts::Ending;

/// Counters, metric lines, and evaluations that came in.
#[derive(Debug)]
pub(super) struct Reports {
    metrics: MetricsFile,
    /// Shows the newest metrics, and collects the evaluations that actors report.
    service: TrainerHandle,
    prometheus: Arc<Prometheus>,
    /// Seconds between two lines.
    interval: f64,
    tasks: Vec<String>,
    /// The newest finite losses, as a line shows them.
    losses: Map<String, Value>,
    /// The last update's losses, if reading them at once would mean to wait for the device.
    deferred: Option<Losses>,
    /// The newest state of the replay, if there is one.
    replay: Option<ReplayReport>,
    waited: Waited,
}

impl Reports {
    /// Opens the metrics of `run`.
    ///
    /// # Errors
    /// When their file cannot be opened.
    pub(super) fn open(run: &Path, experiment: &Experiment, spec: &TaskSpec, service: TrainerHandle) -> Result<Self> {
        Ok(Self {
            metrics: MetricsFile::open(run, experiment, spec)?,
            prometheus: service.prometheus.clone(),
            service,
            interval: experiment.learner.metrics_seconds,
            tasks: spec.tasks.iter().map(|task| task.name.clone()).collect(),
            losses: Map::new(),
            deferred: None,
            replay: None,
            waited: Waited::default(),
        })
    }

    /// Begins a learner epoch at this progress.
    pub(super) fn begin(&mut self, progress: &Progress, accounting: AccountingByTask) {
        self.metrics.begin(progress.epoch, progress.environment_steps, accounting);
    }

    /// Ends the learner epoch.
    pub(super) fn end(&mut self, ended: &Result<Ending>) {
        self.metrics.end(match ended {
            Ok(Ending::Budget) => State::Over,
            Ok(Ending::Stopped) => State::Stopped,
            Err(_) => State::Failed,
        });
    }

    /// Writes the run's page if the last one is a minute old.
    pub(super) fn write_page_when_due(&mut self) {
        self.metrics.write_page_when_due();
    }

    /// Counts the rows and episodes of a batch that was used, and returns its environment steps.
    pub(super) fn count_rows(&mut self, batch: &Batch) -> u64 {
        let mut environment_steps = 0;
        for (rows, task) in self.metrics.count_rows(batch).into_iter().zip(&self.tasks) {
            environment_steps += rows.environment_steps;
            self.prometheus.count_rows(task, rows);
        }
        for UnrollHeader { actor, incarnation, sequence, version, .. } in batch.headers() {
            tracing::trace!(actor, incarnation = format_args!("{incarnation:016x}"), sequence, version, "trained on");
        }
        let episodes = batch.headers().iter().flat_map(|header| &header.episodes);
        let diverged = episodes.filter(|episode| episode.end() == EpisodeEnd::Diverged).count();
        self.prometheus.episodes_diverged.inc_by(diverged as u64);
        environment_steps
    }

    /// Counts an update of so many gradient steps on a batch whose parameters were `version`; the duration is counted by
    /// [`count_duration`](Self::count_duration).
    pub(super) fn count_update(&mut self, batch: &Batch, version: u64, steps: u64) {
        self.prometheus.gradient_steps.inc_by(steps);
        self.metrics.count_update();
        self.metrics.count_episodes(batch.headers(), version);
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
        self.metrics.count_skipped(skipped);
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
        if self.tasks.len() > 1 && losses.temperatures.len() == self.tasks.len() {
            let named = self.tasks.iter().cloned().zip(losses.temperatures.iter().map(|eta| json!(eta)));
            self.losses.insert("temperatures".to_string(), Value::Object(named.collect()));
        }
    }

    /// Whether the last line is old enough for another one.
    pub(super) fn are_due(&self) -> bool {
        self.metrics.elapsed() >= self.interval
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
        self.metrics.keep_evaluations(&evaluations);
        evaluations.iter().filter_map(|evaluation| evaluation.evaluated()).collect()
    }

    /// Writes a line of metrics if it says anything new.
    pub(super) fn write_news(&mut self, progress: &Progress, accounting: AccountingByTask) {
        if self.metrics.has_news(&accounting) {
            self.write(progress, accounting);
        }
    }

    /// Writes a line of metrics, and shows it as the run's status.
    pub(super) fn write(&mut self, progress: &Progress, accounting: AccountingByTask) {
        let position = Position {
            seconds: progress.seconds,
            environment_steps: progress.environment_steps,
            updates: progress.updates,
            gradient_steps: progress.gradient_steps,
            version: progress.version,
            epoch: progress.epoch,
            waited: self.waited,
        };
        let line = self.metrics.write(position, accounting, self.losses.clone(), self.replay);
        tracing::info!(target: "metrics", "{line}");
        self.service.set_metrics(line);
    }
}
