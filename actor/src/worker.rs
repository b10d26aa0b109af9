//! The worker: one thread steps its environments and fills one unroll of each.
//!
//! Every environment writes exactly one row an iteration of the [acting loop](crate::acting_loop). So all unrolls of a
//! thread begin and end together, and parameters change only there. The iteration of row t copies the current observation
//! into row t, makes one forward pass for all environments, samples the actions, writes them into row t, and steps every
//! environment. In transfer the actions are latents, and a frozen low level turns them into commands before the step.
//!
//! An episode's last observation takes a row of its own, without an action (`Valid` 0). That iteration resets the
//! environment and does not step it, so the next row is the next episode's first. Row T holds the observation after the
//! last transition. Row 0 of the next unroll repeats it. Only where row T is an episode's last observation does the next
//! unroll begin with a new episode.
//!
//! An unroll belongs to one task. In joint training the next episode may belong to another task. That episode waits for the
//! next unroll, and the rows up to there are padding: `Valid` 0, `First` 1, the last observation again.

mod recorder;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use comic_proto::UnrollLayout;
use comic_proto::v1::EpisodeStatistics;
use comic_tasks::Environment;
use tokio::sync::mpsc;

use crate::Error;
use crate::acting_loop::{ActingLoop, Controller};
use crate::forward_pass::ForwardPass;
use crate::mailbox::{Directive, Mailbox};
use crate::round::{Round, Ticket};
use recorder::{RecordedUnroll, UnrollRecorder};

/// A full unroll. The connection adds actor, incarnation and sequence number.
#[derive(Clone, Debug)]
pub struct FinishedUnroll {
    /// Little-endian arrays in the layout's order.
    pub payload: Bytes,
    /// Learner epoch of the parameters that acted.
    pub learner_epoch: u64,
    /// Version of the parameters that acted, from the first row to the last.
    pub version: u64,
    /// Episodes that ended in this unroll.
    pub episodes: Vec<EpisodeStatistics>,
    /// The environment's number.
    pub environment: u32,
    /// Index of the unroll's task among the tasks of the experiment.
    pub task: u32,
    /// Held until the learner has answered, where the worker waits for that.
    pub ticket: Option<Arc<Ticket>>,
}

/// How often a worker acts with the same parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// For as many unrolls as the learner takes.
    Free,
    /// For one unroll of every environment. The next unroll waits for the next version, which the learner publishes after
    /// it has trained on all of them.
    Lockstep,
}

/// Counts of a process since its start, for its log.
#[derive(Debug, Default)]
pub struct Progress {
    /// Transitions simulated.
    pub steps: AtomicU64,
    /// Episodes ended.
    pub episodes: AtomicU64,
}

/// E environments and the behaviour policy that controls them.
#[derive(Debug)]
pub struct Worker<E, F> {
    acting: ActingLoop<E>,
    recorder: UnrollRecorder,
    forward: F,
    length: usize,
    /// The number of the first environment.
    first: u32,
    /// What the current unroll is made with; none before the first directive.
    directive: Option<Arc<Directive>>,
}

impl<E: Environment, F: ForwardPass> Worker<E, F> {
    /// Resets every environment.
    ///
    /// The environments are numbered from `first` on. `seed` and its number decide the noise of an environment's latents
    /// and actions.
    ///
    /// # Errors
    /// The unrolls have a place for derivatives, and an environment's body has none.
    pub fn new(
        environments: Vec<E>,
        forward: F,
        layout: Arc<UnrollLayout>,
        first: u32,
        seed: u64,
    ) -> Result<Self, Error> {
        let (length, records) = (layout.shape().length, layout.shape().action_gradient > 0);
        let mut acting = ActingLoop::new(environments, layout.shape(), forward.low_level());
        let recorder = UnrollRecorder::new(layout, forward.low_level(), (first..).take(acting.rollouts.len()), seed);
        for (index, rollout) in acting.rollouts.iter_mut().enumerate() {
            if records {
                rollout.environment.record_gradients()?;
            }
            rollout.environment.reset();
            rollout.begin_episode(&mut acting.batch.row(index));
        }
        Ok(Self { acting, recorder, forward, length, first, directive: None })
    }

    /// Acts by the newest directive and sends every full unroll to `unrolls`, until the mailbox or the channel is closed.
    /// Between rounds the environments wait until the learner has answered for every unroll of the last round, and then
    /// for parameters as `pace` says.
    ///
    /// # Errors
    /// Parameters that do not fit, or a failing forward pass.
    pub fn run(
        mut self,
        pace: Pace,
        mailbox: &Mailbox,
        unrolls: &mpsc::Sender<FinishedUnroll>,
        progress: &Progress,
    ) -> Result<(), Error> {
        while let Some(directive) = mailbox.wait_from(self.oldest_wanted(pace)) {
            self.adopt(&directive)?;
            let finished =
                tracing::debug_span!("rollout", environments = self.acting.rollouts.len(), version = directive.version)
                    .in_scope(|| self.unroll(&|| mailbox.is_closed(), progress))?;
            let Some(finished) = finished else { return Ok(()) };
            let round = Round::default();
            for mut unroll in finished {
                unroll.ticket = Some(round.ticket());
                if unrolls.blocking_send(unroll).is_err() {
                    return Ok(());
                }
            }
            round.wait();
        }
        Ok(())
    }

    /// Learner epoch and version of the oldest parameters for the next unroll.
    fn oldest_wanted(&self, pace: Pace) -> (u64, u64) {
        match (pace, &self.directive) {
            (Pace::Lockstep, Some(last)) => (last.learner_epoch, last.version.saturating_add(1)),
            (Pace::Lockstep, None) | (Pace::Free, _) => (0, 0),
        }
    }

    /// Uses a directive from the next unroll on.
    ///
    /// # Errors
    /// Parameters that do not fit.
    pub fn adopt(&mut self, directive: &Arc<Directive>) -> Result<(), Error> {
        if self.directive.as_ref().is_some_and(|current| Arc::ptr_eq(current, directive)) {
            return Ok(());
        }
        self.forward.load(&directive.parameters)?;
        self.directive = Some(Arc::clone(directive));
        Ok(())
    }

    /// One unroll of every environment; `None` when `stopped` says so, and the unfinished unrolls are lost.
    ///
    /// # Errors
    /// A failing forward pass.
    pub fn unroll(
        &mut self,
        stopped: &dyn Fn() -> bool,
        progress: &Progress,
    ) -> Result<Option<Vec<FinishedUnroll>>, Error> {
        let Self { acting, recorder, forward, length, .. } = self;
        let mut controller = Controller::Policy(forward);
        for t in 0..*length {
            if stopped() {
                return Ok(None);
            }
            (recorder.t, recorder.steps, recorder.episodes) = (t, 0, 0);
            // The recorder never breaks.
            let _ = acting.iterate(&mut controller, recorder)?;
            progress.steps.fetch_add(recorder.steps, Ordering::Relaxed);
            progress.episodes.fetch_add(recorder.episodes, Ordering::Relaxed);
        }
        recorder.t = *length;
        acting.observe(recorder)?;
        self.finish().map(Some)
    }

    fn finish(&mut self) -> Result<Vec<FinishedUnroll>, Error> {
        let (learner_epoch, version) =
            self.directive.as_ref().map_or((0, 0), |newest| (newest.learner_epoch, newest.version));
        let ActingLoop { rollouts, batch } = &mut self.acting;
        let mut unrolls = Vec::with_capacity(rollouts.len());
        for ((index, rollout), environment) in rollouts.iter_mut().enumerate().zip(self.first..) {
            let gradients = rollout.environment.take_gradients();
            self.recorder.write_gradients(index, &gradients, &mut self.forward)?;
            let RecordedUnroll { payload, episodes, task } = self.recorder.take(index);
            if rollout.ended {
                rollout.environment.reset();
                rollout.begin_episode(&mut batch.row(index));
            }
            let ticket = None;
            unrolls.push(FinishedUnroll { payload, learner_epoch, version, episodes, environment, task, ticket });
        }
        Ok(unrolls)
    }
}

#[cfg(test)]
mod tests;
