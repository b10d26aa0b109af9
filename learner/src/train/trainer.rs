//! The trainer: one OS thread that owns the device. Batches in, parameters out.

use std::time::{Duration, Instant};

use comic_experiment::{Experiment, TaskSpec};
use comic_replay::{Batch, Batcher, LedgerSnapshot, Next, Reason};

use crate::algorithm::Parts;
use crate::algorithm::experience::Experience;
use crate::algorithm::loss_report::{LossValues, Losses};
use crate::algorithms;
use crate::checkpoint::saved_replay::SavedReplay;
use crate::checkpoint::snapshot::LEARNED;
use crate::checkpoint::{Name, Snapshot, incompatible};
use crate::device::Backend;
use crate::error::{Error, Result};
use crate::observe::metrics_file::Waited;
use crate::service::TrainerHandle;
use crate::service::memory::{Bounds, Sizes};
use crate::train::budget::BudgetClock;
use crate::train::checkpoints::Checkpoints;
use crate::train::parts::{Ending, TrainerParts};
use crate::train::reports::Reports;
use crate::train::resumed_replay::begin_replay;
use crate::train::rounds::{Contents, Round, Said, check_equality};
use crate::train::skipped_steps::{Recovery, SkippedSteps, remedies};
use crate::train::state::State;
use crate::train::versions::Versions;
use crate::world::{MEETING, SILENCE, World};

/// How often a trainer without batches looks at the clock.
const PATIENCE: Duration = Duration::from_millis(500);

/// Learns from batches until the budget is used up or the batcher is closed.
#[derive(Debug)]
pub struct Trainer {
    experiment: Experiment,
    spec: TaskSpec,
    backend: Backend,
    batcher: Batcher,
    state: State,
    experience: Box<dyn Experience>,
    /// Where the replay is saved, if the experiment wants that.
    saved_replay: Option<SavedReplay>,
    /// How long the trainer has waited for unrolls.
    waited: Duration,
    skipped_steps: SkippedSteps,
    budget: BudgetClock,
    versions: Versions,
    reports: Reports,
    checkpoints: Checkpoints,
    service: TrainerHandle,
    world: World,
}

impl Trainer {
    /// A trainer at the beginning of its run, or at its checkpoint. A new run gets its `initial` checkpoint.
    ///
    /// # Errors
    /// A checkpoint that does not fit the experiment; a disk that refuses.
    pub fn new(parts: TrainerParts) -> Result<Self> {
        let TrainerParts {
            experiment,
            spec,
            pose,
            low_level,
            backend,
            world,
            run,
            epoch,
            resume,
            batcher,
            publisher,
            service,
        } = parts;
        backend.train_here()?;
        let share = experiment.share(world.size())?;
        let parts = Parts { experiment: &share, spec: &spec, pose: &pose, device: backend.device(), world: &world };
        let mut state = State::new(parts, low_level, service.id(), epoch)?;
        if let Some(snapshot) = &resume {
            state.restore(snapshot, service.id(), epoch).map_err(|error| incompatible(&run, error))?;
        }
        let own_run = world.is_first().then_some(run.as_path());
        let mut reports = Reports::open(own_run, &experiment, &spec, service.clone())?;
        reports.begin(&state.progress, batcher.accounting_by_task());
        let mut experience = algorithms::experience(parts, batcher.layout())?;
        let saved_replay = experiment.replay.save.then(|| SavedReplay::of(&run));
        if let Some(replay) = experience.replay() {
            let resumed = resume.as_ref().map(|_| state.progress.updates);
            begin_replay(replay, saved_replay.as_ref(), resumed, &run)?;
        }
        let mut trainer = Self {
            experience,
            saved_replay,
            waited: Duration::ZERO,
            skipped_steps: SkippedSteps::new(experiment.learner.restore_after),
            budget: BudgetClock::new(experiment.budget.clone(), state.progress.seconds),
            versions: Versions::new(batcher.clone(), publisher, &experiment),
            checkpoints: Checkpoints::start(own_run, &experiment.learner, service.clone())?,
            experiment,
            spec,
            backend,
            batcher,
            state,
            reports,
            service,
            world,
        };
        match resume {
            Some(snapshot) => trainer.checkpoints.set_good(snapshot),
            None => trainer.write_checkpoint_if_sound(Name::Initial)?,
        }
        tracing::info!("buffers take {}", trainer.memory());
        Ok(trainer)
    }

    /// Trains, and writes a last checkpoint.
    ///
    /// # Errors
    /// When gradient steps are still skipped after the last good state was restored, or when the disk refuses.
    pub fn run(mut self) -> Result<Ending> {
        let trained = self.train_to_the_end();
        let Self { checkpoints, saved_replay, state, mut reports, world, .. } = self;
        // What the writer was given is good after an error, too.
        let written = checkpoints.finish();
        let ended = trained.and_then(|ending| {
            written?;
            if let Some(saved) = saved_replay {
                saved.remove_earlier(state.progress.updates)?;
            }
            // No rank ends well before the last checkpoint is on disk.
            world.exchange(())?;
            Ok(ending)
        });
        reports.end(&ended);
        ended
    }

    fn train_to_the_end(&mut self) -> Result<Ending> {
        // Each has prepared itself in its own time.
        self.world.exchange(())?;
        self.world.wait_for(SILENCE);
        let ending = self.train()?;
        // The disk of rank 0 may be slow.
        self.world.wait_for(MEETING);
        self.report_deferred()?;
        self.take_evaluations()?;
        self.write_metrics(true)?;
        self.write_last_checkpoint()?;
        Ok(ending)
    }

    fn train(&mut self) -> Result<Ending> {
        self.reports.write_page_when_due();
        match self.state.progress.version {
            0 => self.publish()?,
            _ => self.versions.announce(&self.state)?,
        }
        // A batch that waits for those of the other ranks.
        let mut held = None;
        loop {
            let next = match held.take() {
                Some(batch) => Next::Batch(batch),
                None if self.budget.used(&self.state.progress) >= 1.0 => Next::Elapsed,
                None => self.next_batch(),
            };
            let round = self.decide(&next)?;
            if round.metrics {
                self.write_metrics(false)?;
            }
            match (next, &round.batch) {
                (Next::Batch(batch), Some(whole)) => self.learn(batch, whole, &round)?,
                _ if round.used >= 1.0 => return Ok(Ending::Budget),
                _ if round.stops => return Ok(Ending::Stopped),
                (Next::Batch(batch), None) => held = Some(batch),
                (Next::Elapsed | Next::Closed, _) => {}
            }
        }
    }

    /// What all ranks do next.
    fn decide(&mut self, next: &Next) -> Result<Round> {
        self.service.beat();
        let said = Said {
            batch: next.batch().map(|batch| Contents::of(batch, self.spec.tasks.len())),
            stops: self.batcher.is_closed(),
            actors: self.service.actors(),
            used: self.budget.used(&self.state.progress),
            checkpoint: self.checkpoints.are_due(),
            metrics: self.reports.are_due(),
        };
        let round = Round::of(&self.world, said)?;
        self.service.place_actors(&round.actors);
        self.reports.write_page_when_due();
        Ok(round)
    }

    /// One batch: gradient steps on it, its accounting, and new parameters when they are due.
    fn learn(&mut self, batch: Batch, whole: &Contents, round: &Round) -> Result<()> {
        self.budget.start();
        let began = Instant::now();
        let _update = tracing::debug_span!("update", update = self.state.progress.updates + 1).entered();
        if self.collect(&batch, &whole.tasks)? {
            return self.skip_batch(batch, round);
        }
        let (steps, losses) = self.take_gradient_steps(&batch, round.used)?;
        let publishes = self.state.algorithm.publishes_after(self.state.progress.updates + 1, steps);
        // Only a learner alone may look at the clock again.
        let due = round.checkpoint || (self.world.size() == 1 && self.checkpoints.are_due());
        let restored = self.report_when_ready(losses, publishes || due)?;
        let version = self.state.progress.version;
        self.state.progress.updates += 1;
        self.state.progress.gradient_steps += steps;
        self.reports.count_update(&batch, version, steps);
        let ages = batch.headers().iter().map(|header| version.saturating_sub(header.version)).collect();
        // Before the batch's memory is free: actors that wait for it then continue with these parameters.
        if restored || publishes {
            self.publish()?;
        } else {
            self.versions.repeat(&mut self.state)?;
        }
        self.state.progress.environment_steps += whole.environment_steps;
        self.reports.count_rows(&batch);
        self.batcher.trained(batch);
        self.reports.count_duration(began.elapsed(), ages);
        self.after_update(due)
    }

    /// Adds a batch to the statistics of the observations while they are still collected. They take effect with the next
    /// publication. Says whether the batch is the first one of a task; `tasks` are those of all ranks' batches.
    fn collect(&mut self, batch: &Batch, tasks: &[usize]) -> Result<bool> {
        let (wanted, seen) = (self.experiment.network.normaliser_steps as f64, self.state.statistics.rows());
        let first = wanted > 0.0 && self.state.statistics.lacks(tasks);
        if first || seen < wanted {
            self.state.statistics.absorb(batch, &self.world)?;
        }
        Ok(first)
    }

    /// The first batch of a task only sets the scale of its observations, because without it the networks would learn
    /// nothing. Unrolls so far were made with another scale.
    fn skip_batch(&mut self, batch: Batch, round: &Round) -> Result<()> {
        self.versions.supersede(&self.state);
        // Also after a gradient step that was skipped, which changed no parameter: the next batch needs the scale.
        match self.state.algorithm.is_finite() {
            true => self.versions.publish(&mut self.state)?,
            false => self.versions.repeat(&mut self.state)?,
        }
        self.batcher.discard(batch, Reason::Superseded);
        self.after_update(round.checkpoint)
    }

    /// The gradient steps on a batch: how many, and the mean of their losses.
    fn take_gradient_steps(&mut self, batch: &Batch, used: f64) -> Result<(u64, Option<Losses>)> {
        self.state.algorithm.set_progress(used);
        let mut losses = Vec::new();
        let random = &mut self.state.progress.random;
        for step in 0..self.experience.take(batch, random)? {
            self.service.beat();
            let minibatch = self.experience.minibatch(step, random)?;
            if !losses.is_empty() {
                self.backend.end_step()?;
            }
            let step = tracing::debug_span!("gradient_step").in_scope(|| self.state.algorithm.step(&minibatch));
            losses.push(step?);
        }
        let (steps, losses) = (losses.len() as u64, Losses::mean(&losses));
        self.experience.release();
        self.backend.end_step()?;
        Ok((steps, losses))
    }

    fn next_batch(&mut self) -> Next {
        let began = Instant::now();
        let next = self.experience.next(&self.batcher, PATIENCE);
        self.waited += began.elapsed();
        next
    }

    /// Publishes the online policy as the next version, if it is sound: actors that cannot act would send nothing that
    /// shows the failure.
    fn publish(&mut self) -> Result<()> {
        if self.is_sound() {
            return self.versions.publish(&mut self.state);
        }
        let update = self.state.progress.updates;
        tracing::warn!(update, "not published: the last gradient steps were not finite");
        self.versions.repeat(&mut self.state)
    }

    /// Whether the parameters can be published and restored: every one is a number, and the last gradient step was taken.
    fn is_sound(&self) -> bool {
        !self.skipped_steps.last_was_skipped() && self.state.algorithm.is_finite()
    }

    /// Reports the losses of an update. An asynchronous device is not waited for: its losses are reported when the next
    /// update is on its way, or `at_once` where the device is waited for anyway. Returns whether the last good state was
    /// restored.
    fn report_when_ready(&mut self, losses: Option<Losses>, at_once: bool) -> Result<bool> {
        self.reports.count_compilations(self.backend.compilations()?);
        let restored = self.report_deferred()?;
        match losses {
            // They belong to the state that was left.
            Some(losses) if restored => self.reports.count_skipped(losses.to_values().skipped),
            Some(losses) if at_once || !self.backend.is_asynchronous() => return self.report(&losses.to_values()),
            losses => self.reports.defer(losses),
        }
        Ok(restored)
    }

    fn report_deferred(&mut self) -> Result<bool> {
        match self.reports.take_deferred() {
            Some(losses) => self.report(&losses.to_values()),
            None => Ok(false),
        }
    }

    /// Reports losses, and recovers from steps that were skipped. Returns whether the last good state was restored, which
    /// has to be published then.
    ///
    /// # Errors
    /// [`Error::Diverged`] when it was restored before and that did not help.
    fn report(&mut self, losses: &LossValues) -> Result<bool> {
        let update = self.state.progress.updates;
        self.reports.count_skipped(losses.skipped);
        let recovery = self.skipped_steps.count(losses, update);
        match recovery {
            Recovery::Continue => {}
            Recovery::Restore => self.restore_last_good()?,
            Recovery::GiveUp => {
                return Err(Error::Diverged(format!("update {update}: {}", remedies(self.state.algorithm.remedies()))));
            }
        }
        self.reports.keep_losses(losses);
        Ok(recovery == Recovery::Restore)
    }

    /// Continues with the parameters, moments and statistics of the last good state; the progress stays. Unrolls of earlier
    /// versions are superseded, because they were made with the parameters that failed.
    fn restore_last_good(&mut self) -> Result<()> {
        self.state.restore_learned(self.checkpoints.good())?;
        self.reports.count_restore();
        self.versions.supersede(&self.state);
        let update = self.state.progress.updates;
        tracing::warn!(update, "too many gradient steps in a row were skipped: the last good state is restored");
        Ok(())
    }

    /// Writes a checkpoint if one is due.
    fn after_update(&mut self, due: bool) -> Result<()> {
        if !due {
            return Ok(());
        }
        // Before an older checkpoint is removed, it is judged by what was reported.
        self.take_evaluations()?;
        self.write_checkpoint_if_sound(Name::Updates(self.state.progress.updates))
    }

    /// Writes a line of metrics of what all ranks counted since the last one.
    fn write_metrics(&mut self, last: bool) -> Result<()> {
        // While a checkpoint is being written, evaluations wait, and training does not.
        if !self.checkpoints.is_busy() {
            self.take_evaluations()?;
        }
        self.state.progress.seconds = self.budget.seconds();
        self.show_replay();
        let counted = self.world.exchange(self.reports.take_counted(self.batcher.accounting_by_task()))?;
        self.reports.write(&self.state.progress, counted, last);
        Ok(())
    }

    /// Tells the reports of the replay, and how long each side has waited.
    fn show_replay(&mut self) {
        if let Some(replay) = self.experience.replay() {
            self.reports.set_replay(replay.report());
        }
        let [learner, unrolls] = [self.waited, self.batcher.waited()].map(|waited| waited.as_secs_f64());
        self.reports.set_waited(Waited { learner, unrolls });
    }

    fn take_evaluations(&mut self) -> Result<()> {
        self.reports
            .take_evaluations(&self.state.progress)
            .into_iter()
            .try_for_each(|evaluated| self.checkpoints.judge(evaluated))
    }

    fn write_checkpoint_if_sound(&mut self, name: Name) -> Result<()> {
        if !self.is_sound() {
            tracing::warn!(checkpoint = %name, "not written: the last gradient steps were not finite");
            return Ok(());
        }
        self.save_replay(name);
        let snapshot = self.snapshot(name)?;
        self.checkpoints.write(name, snapshot)
    }

    /// A step that was skipped at the very end changed nothing, so finite parameters are enough. The replay comes after the
    /// checkpoint, because it can take longer than an operator waits.
    fn write_last_checkpoint(&mut self) -> Result<()> {
        let name = Name::Updates(self.state.progress.updates);
        if !self.state.algorithm.is_finite() && !self.is_sound() {
            tracing::warn!(checkpoint = %name, "not written: the last gradient steps were not finite");
            return Ok(());
        }
        let snapshot = self.snapshot(name)?;
        self.checkpoints.write(name, snapshot)?;
        self.save_replay(name);
        Ok(())
    }

    /// Saves the replay for a checkpoint, if the experiment wants that. Training waits meanwhile. If the disk refuses, the
    /// checkpoint has none.
    fn save_replay(&mut self, name: Name) {
        if let (Name::Updates(updates), Some(saved), Some(replay)) =
            (name, &self.saved_replay, self.experience.replay())
            // That of the same number of updates is the same.
            && saved.size(updates) == 0
            && let Err(error) = saved.write(updates, |writer| replay.write_to(writer))
        {
            tracing::error!(checkpoint = %name, "the replay is not saved: {}", comic_proto::chain(&error));
        }
    }

    /// What this checkpoint will have. Every unroll that was acknowledged before the line in the log is in it.
    fn snapshot(&mut self, name: Name) -> Result<Snapshot> {
        tracing::info!(checkpoint = %name, "taking a snapshot");
        self.state.progress.seconds = self.budget.seconds();
        let ledgers = self.world.exchange(self.batcher.snapshot())?;
        let ledger = LedgerSnapshot::of_ranks(ledgers).unwrap_or_else(|| self.batcher.snapshot());
        let snapshot = self.state.snapshot(&self.experiment, &self.spec, &ledger)?;
        check_equality(&self.world, snapshot.part(LEARNED)?, self.state.progress.updates)?;
        Ok(snapshot)
    }

    /// How much memory the learner's buffers can take, now that every size is known.
    fn memory(&mut self) -> Bounds {
        Bounds::new(&Sizes {
            replay: self.experience.replay().map_or(0, |replay| replay.memory()),
            ahead: self.experiment.unroll.ahead,
            batch: self.experiment.unroll.batch / self.world.size(),
            unroll: self.batcher.layout().size(),
            ingest: self.service.ingest(),
            parameters: self.state.target.len(),
            snapshot: self.checkpoints.good().parts.values().map(Vec::len).sum(),
        })
    }
}
