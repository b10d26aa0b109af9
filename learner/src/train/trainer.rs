//! The trainer: one OS thread that owns the device. Batches in, parameters out.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use bytes::Bytes;
use comic_experiment::{Experiment, TaskSpec};
use comic_networks::to_safetensors;
use comic_proto::v1::{Behaviour, EpisodeEnd, UnrollHeader};
use comic_replay::{Batch, Batcher, Next, Phase, Reason};
use rand::SeedableRng as _;
use rand_pcg::Pcg64;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::algorithm::Algorithm as _;
use crate::algorithm::losses::Losses;
use crate::checkpoint::{Name, Snapshot, Store, incompatible};
use crate::device::Backend;
use crate::observe::metrics::{Metrics, Position};
use crate::publish::Publisher;
use crate::service::Shared;
use crate::train::skipped_steps::SkippedSteps;
use crate::train::statistics::ObservationStatistics;
use crate::train::writer::Writer;
use crate::vmpo::VmpoLearner;

/// How often a trainer without batches looks at the clock.
const PATIENCE: std::time::Duration = std::time::Duration::from_millis(500);

/// What a trainer is made of.
#[derive(Debug)]
pub struct Setup {
    /// The resolved experiment.
    pub experiment: Experiment,
    /// The task's sizes and names.
    pub spec: TaskSpec,
    /// Where the policy's mean starts, `[A]`.
    pub pose: Vec<f32>,
    /// Where it computes.
    pub backend: Backend,
    /// The run's directory.
    pub run: PathBuf,
    /// This life of the learner.
    pub epoch: u64,
    /// A checkpoint to go on from.
    pub resume: Option<Snapshot>,
    /// Where batches come from.
    pub batcher: Batcher,
    /// Where parameters go.
    pub publisher: Publisher,
    /// Where the newest metrics are shown.
    pub shared: Arc<Shared>,
}

/// Why training ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// The experiment's budget is used up.
    Budget,
    /// The batcher was closed: somebody asked the learner to stop.
    Stopped,
}

/// Everything that counts, in checkpoints as `progress.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Progress {
    /// The run's number; absent from checkpoints of learners that had none.
    #[serde(default)]
    pub(crate) run: Option<u64>,
    /// The life of the learner that made it, without which the version means nothing.
    pub(crate) epoch: u64,
    pub(crate) updates: u64,
    pub(crate) environment_steps: u64,
    pub(crate) seconds: f64,
    pub(crate) version: u64,
    pub(crate) warm_started: bool,
    /// Decides the minibatches.
    pub(crate) random: Pcg64,
}

/// Learns from batches until the budget is used up or the batcher closed.
#[derive(Debug)]
pub struct Trainer {
    pub(crate) experiment: Experiment,
    pub(crate) spec: TaskSpec,
    pub(crate) epoch: u64,
    pub(crate) backend: Backend,
    pub(crate) learner: VmpoLearner,
    /// The last update's losses, where asking for them at once would mean to wait for the device.
    late: Option<Losses>,
    /// Of the observations, for the normaliser.
    pub(crate) statistics: ObservationStatistics,
    /// The parameters actors act with, as published.
    pub(crate) target: Bytes,
    pub(crate) progress: Progress,
    /// Since when this life counts time, and what had been counted then.
    clock: Option<(Instant, f64)>,
    pub(crate) losses: Map<String, Value>,
    pub(crate) batcher: Batcher,
    publisher: Publisher,
    pub(crate) shared: Arc<Shared>,
    /// Unrolls of versions before this one are superseded.
    pub(crate) oldest: u64,
    pub(crate) metrics: Metrics,
    pub(crate) writer: Writer,
    pub(crate) checkpointed: Instant,
    /// The newest checkpoint, in memory: where a learner turns back to that lost its way.
    pub(crate) good: Arc<Snapshot>,
    pub(crate) skipped_steps: SkippedSteps,
}

impl Trainer {
    /// A trainer at its beginning, or where its checkpoint left it. Fresh runs write their `initial` checkpoint.
    ///
    /// # Errors
    /// A checkpoint that does not fit the experiment; a disk that refuses.
    pub fn new(setup: Setup) -> Result<Self> {
        let Setup { experiment, spec, pose, backend, run, epoch, resume, batcher, publisher, shared } = setup;
        tch::manual_seed(experiment.seed as i64);
        backend.train_here()?;
        let learner = VmpoLearner::new(&spec, &experiment, &pose, backend.device())?;
        let store = Store::open(&run, experiment.learner.checkpoints_kept)?;
        let mut trainer = Self {
            statistics: ObservationStatistics::new(&spec),
            target: Bytes::from(to_safetensors(learner.policy_store())?),
            progress: Progress {
                run: Some(shared.id()),
                epoch,
                updates: 0,
                environment_steps: 0,
                seconds: 0.0,
                version: 0,
                warm_started: experiment.warm_start.steps == 0,
                random: Pcg64::seed_from_u64(experiment.seed),
            },
            clock: None,
            losses: Map::new(),
            oldest: 0,
            metrics: Metrics::open(&run, &spec)?,
            writer: Writer::start(store, shared.telemetry.clone())?,
            checkpointed: Instant::now(),
            good: Arc::default(),
            skipped_steps: SkippedSteps::new(experiment.learner.restore_after),
            experiment,
            spec,
            epoch,
            backend,
            learner,
            late: None,
            batcher,
            publisher,
            shared,
        };
        match resume {
            Some(snapshot) => {
                trainer.restore(&snapshot).map_err(|error| incompatible(&run, error))?;
                trainer.good = Arc::new(snapshot);
            }
            None => trainer.keep(Name::Initial)?,
        }
        let accounting = trainer.batcher.accounting_by_task();
        trainer.metrics.begin(epoch, trainer.progress.environment_steps, accounting);
        tracing::info!("buffers take {}", trainer.memory());
        Ok(trainer)
    }

    /// Demonstrations and regression if the experiment wants them, then V-MPO, then a last checkpoint.
    ///
    /// # Errors
    /// When gradient steps go on being skipped after a return to the last good state, or the disk refuses.
    pub fn run(mut self) -> Result<Ending> {
        let ending = match self.train().and_then(|ending| self.report_late().map(|_| ending)) {
            Ok(ending) => ending,
            Err(error) => {
                // What was handed to the writer is still good.
                let _ = self.writer.finish();
                return Err(error);
            }
        };
        self.take_evaluations()?;
        self.write_metrics()?;
        self.checkpoint(true)?;
        self.writer.finish()?;
        Ok(ending)
    }

    fn train(&mut self) -> Result<Ending> {
        if !self.progress.warm_started && self.warm_start()?.is_none() {
            return Ok(Ending::Stopped);
        }
        match self.progress.version {
            0 => self.publish(Behaviour::Policy)?,
            _ => self.announce(Behaviour::Policy),
        }
        while !self.budget_used_up() {
            match self.next_batch()? {
                Wait::Batch(batch) => self.learn(batch)?,
                Wait::Nothing => {}
                Wait::Closed => return Ok(Ending::Stopped),
            }
        }
        Ok(Ending::Budget)
    }

    /// One batch: gradient steps on it, its accounting, and new parameters when they are due.
    fn learn(&mut self, batch: Batch) -> Result<()> {
        let began = Instant::now();
        let _update = tracing::debug_span!("update", update = self.progress.updates + 1).entered();
        let tensors = tracing::debug_span!("to_device").in_scope(|| self.tensors(&batch))?;
        let unseen = self.normalises() && self.statistics.lacks(&batch.tasks());
        if unseen || self.normalises_still() {
            self.absorb(&batch);
            self.set_normaliser()?;
            if unseen {
                // Numbers of any size would teach the networks nothing: a task's first batch only sets the scale.
                // What was made before acts on another scale.
                self.oldest = self.progress.version + 1;
                self.publish(Behaviour::Policy)?;
                self.batcher.discard(batch, Reason::Superseded);
                return self.after_update();
            }
        }
        self.schedule_learning_rate();
        let mut losses = Vec::new();
        for minibatch in self.minibatches(&tensors) {
            if !losses.is_empty() {
                self.backend.end_step()?;
            }
            losses.push(tracing::debug_span!("gradient_step").in_scope(|| self.learner.step(&minibatch))?);
        }
        let losses = Losses::mean(&losses);
        drop(tensors);
        self.backend.end_step()?;
        let publishes = (self.progress.updates + 1).is_multiple_of(self.experiment.vmpo.target_period);
        let restored = self.report_when_there(losses, publishes || self.checkpoint_is_due())?;
        self.progress.updates += 1;
        self.metrics.count_update();
        self.metrics.absorb(batch.headers(), self.progress.version);
        let ages = batch.headers().iter().map(|header| self.progress.version.saturating_sub(header.version)).collect();
        // Published before the batch goes back: whoever waits for its room goes on with these parameters.
        if restored || publishes {
            self.publish(Behaviour::Policy)?;
        } else {
            self.keep_step(Behaviour::Policy);
        }
        self.book(batch);
        self.shared.telemetry.count_update(began.elapsed(), ages);
        self.after_update()
    }

    /// Reports the losses of an update; those of a device that works by itself when the next update is on its way, so that
    /// it never waits for somebody to read, or `at_once` where it is waited for anyway. Says whether they led back to the last
    /// good state.
    fn report_when_there(&mut self, losses: Option<Losses>, at_once: bool) -> Result<bool> {
        self.shared.telemetry.count_compilations(self.backend.compilations()?);
        let restored = self.report_late()?;
        match losses {
            // Of the state that was left.
            Some(losses) if restored => self.count_skipped(losses.to_values().skipped),
            Some(losses) if at_once || !self.backend.is_asynchronous() => return self.report(&losses.to_values()),
            losses => self.late = losses,
        }
        Ok(restored)
    }

    fn report_late(&mut self) -> Result<bool> {
        match self.late.take() {
            Some(losses) => self.report(&losses.to_values()),
            None => Ok(false),
        }
    }
}

/// What waiting for a batch led to.
pub(crate) enum Wait {
    Batch(Batch),
    Nothing,
    Closed,
}

impl Trainer {
    pub(crate) fn next_batch(&mut self) -> Result<Wait> {
        let next = self.batcher.next_batch_within(PATIENCE);
        self.write_metrics_when_due()?;
        Ok(match next {
            Next::Batch(batch) => {
                let seconds = self.progress.seconds;
                self.clock.get_or_insert_with(|| (Instant::now(), seconds));
                Wait::Batch(batch)
            }
            Next::Elapsed => Wait::Nothing,
            Next::Closed => Wait::Closed,
        })
    }

    /// Counts a batch's steps and diverged episodes, and gives its memory back.
    pub(crate) fn book(&mut self, batch: Batch) {
        for (rows, task) in self.metrics.count_rows(&batch).into_iter().zip(&self.spec.tasks) {
            self.progress.environment_steps += rows.environment_steps;
            self.shared.telemetry.count_rows(&task.name, rows);
        }
        let episodes = batch.headers().iter().flat_map(|header| &header.episodes);
        for UnrollHeader { actor, incarnation, sequence, .. } in batch.headers() {
            tracing::trace!(actor, incarnation = format_args!("{incarnation:016x}"), sequence, "trained on");
        }
        let diverged = episodes.filter(|episode| episode.end() == EpisodeEnd::Diverged).count();
        self.shared.telemetry.episodes_diverged.inc_by(diverged as u64);
        self.batcher.trained(batch);
    }

    /// Publishes the online policy as the next version: from now on it is the target network, with which actors act.
    /// One that is not sound stays here: from actors that cannot act nothing comes that would show it.
    pub(crate) fn publish(&mut self, behaviour: Behaviour) -> Result<()> {
        if !self.is_sound() {
            tracing::warn!(update = self.progress.updates, "not published: the last gradient steps were not finite");
            self.keep_step(behaviour);
            return Ok(());
        }
        let _publish = tracing::debug_span!("publish", version = self.progress.version + 1).entered();
        self.target = Bytes::from(to_safetensors(self.learner.policy_store())?);
        self.progress.version += 1;
        self.announce(behaviour);
        Ok(())
    }

    /// In lockstep actors make one unroll of each environment with each version, so a batch that changes no parameters
    /// they act with is answered by the same ones as another version.
    pub(crate) fn keep_step(&mut self, behaviour: Behaviour) {
        if self.experiment.unroll.lockstep {
            self.progress.version += 1;
            self.announce(behaviour);
        }
    }

    /// Tells actors and batcher of the newest version, for instance after a restart.
    fn announce(&self, behaviour: Behaviour) {
        let version = self.progress.version;
        self.batcher.set_phase(Phase { epoch: self.epoch, version, oldest: self.oldest, behaviour });
        self.publisher.publish(version, behaviour, &self.target);
    }

    fn normalises(&self) -> bool {
        self.experiment.network.normaliser_steps > 0
    }

    fn normalises_still(&self) -> bool {
        self.statistics.rows() < self.experiment.network.normaliser_steps as f64
    }

    pub(crate) fn absorb(&mut self, batch: &Batch) {
        self.statistics.absorb(batch);
    }

    pub(crate) fn set_normaliser(&mut self) -> Result<()> {
        Ok(self.learner.set_normaliser(&self.statistics.to_normaliser()?)?)
    }

    pub(crate) fn seconds(&self) -> f64 {
        self.clock.map_or(self.progress.seconds, |(start, before)| before + start.elapsed().as_secs_f64())
    }

    /// Assignment of the budget that is used up, by whichever limit is nearest.
    fn share_used(&self) -> f64 {
        let budget = &self.experiment.budget;
        [
            (self.seconds() / 60.0, budget.minutes),
            (self.progress.environment_steps as f64, budget.environment_steps as f64),
            (self.progress.updates as f64, budget.updates as f64),
        ]
        .into_iter()
        .filter(|(_, limit)| *limit > 0.0)
        .map(|(used, limit)| used / limit)
        .fold(0.0, f64::max)
    }

    fn budget_used_up(&self) -> bool {
        self.share_used() >= 1.0
    }

    fn schedule_learning_rate(&mut self) {
        let optimiser = &self.experiment.optimiser;
        let share = 1.0 - (1.0 - optimiser.final_learning_rate_share) * self.share_used().min(1.0);
        self.learner.set_learning_rates(optimiser.learning_rate * share, optimiser.multiplier_learning_rate);
    }

    pub(crate) fn after_update(&mut self) -> Result<()> {
        self.write_metrics_when_due()?;
        if self.checkpoint_is_due() { self.checkpoint(false) } else { Ok(()) }
    }

    fn checkpoint_is_due(&self) -> bool {
        self.checkpointed.elapsed().as_secs_f64() >= self.experiment.learner.checkpoint_seconds
    }

    pub(crate) fn write_metrics_when_due(&mut self) -> Result<()> {
        if self.metrics.elapsed() < self.experiment.learner.metrics_seconds {
            return Ok(());
        }
        // Otherwise they wait where they are, and training goes on.
        if !self.writer.is_busy() {
            self.take_evaluations()?;
        }
        if self.metrics.has_news(&self.batcher.accounting_by_task()) { self.write_metrics() } else { Ok(()) }
    }

    /// Keeps what actors found out about checkpoints.
    fn take_evaluations(&self) -> Result<()> {
        for evaluation in self.shared.take_evaluations() {
            self.metrics.keep_evaluation(&evaluation);
            if let Some(evaluated) = evaluation.evaluated() {
                self.writer.judge(evaluated)?;
            }
        }
        Ok(())
    }

    fn write_metrics(&mut self) -> Result<()> {
        let position = Position {
            seconds: self.seconds(),
            environment_steps: self.progress.environment_steps,
            updates: self.progress.updates,
            version: self.progress.version,
            epoch: self.epoch,
        };
        let accounting = self.batcher.accounting_by_task();
        let line = self.metrics.write(position, accounting, self.losses.clone());
        tracing::info!(target: "metrics", "{line}");
        self.shared.set_metrics(line);
        Ok(())
    }
}
