//! The hot path: one thread steps its environments and fills one unroll of each.
//!
//! Every environment writes exactly one row an iteration, so all unrolls of a thread begin and end together, and
//! parameters change there and nowhere else. An iteration is observe → act → step:
//!
//! - *observe* copies the current observation of every environment into row t;
//! - *act* makes one forward pass for all of them;
//! - *step* samples the actions, writes them into row t, and moves every environment on.
//!
//! An episode's last observation takes a row of its own, in which nothing is done (`Valid` 0): that iteration resets
//! the environment instead of stepping it, so the next row is the next episode's first. Row T is the observation that
//! follows the last slot, and row 0 of the next unroll is the same observation again; only where row T is an episode's
//! last, the next unroll starts with the fresh episode instead.
//!
//! An unroll is of one task. Where joint training draws another one for the next episode, that episode waits for the next
//! unroll, and the rows up to there are padding: `Valid` 0, `First` 1, the last observation again.

mod lane;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use comic_proto::UnrollLayout;
use comic_proto::v1::{Behaviour, EpisodeStatistics};
use comic_tasks::Environment;
use tokio::sync::mpsc;

use crate::Error;
use crate::acting::{ActingBatch, ActingSizes, ForwardPass};
use crate::mailbox::{Directive, Mailbox};
use crate::round::{Round, Ticket};
use lane::Lane;

/// A full unroll, without what only the connection knows (actor, incarnation, sequence number).
#[derive(Clone, Debug)]
pub struct FinishedUnroll {
    /// Little-endian arrays in the layout's order.
    pub payload: Bytes,
    /// Learner epoch of the parameters that acted.
    pub learner_epoch: u64,
    /// Version of the parameters that acted, from the first row to the last.
    pub version: u64,
    /// What acted, from the first row to the last.
    pub behaviour: Behaviour,
    /// Episodes that ended in this unroll.
    pub episodes: Vec<EpisodeStatistics>,
    /// The environment's number.
    pub environment: u32,
    /// Index of the unroll's task among the tasks of the experiment.
    pub task: u32,
    /// Held until the learner has answered for it, if somebody waits for that.
    pub ticket: Option<Arc<Ticket>>,
}

/// How often a worker acts with the same parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// For as many unrolls as the learner takes.
    Free,
    /// For one unroll of every environment: the next one waits for the next version, which the learner publishes when it
    /// has learnt from all of them.
    Lockstep,
}

/// What a process has done so far, for its log.
#[derive(Debug, Default)]
pub struct Progress {
    /// Transitions simulated.
    pub steps: AtomicU64,
    /// Episodes ended.
    pub episodes: AtomicU64,
}

/// E environments and the behaviour policy that moves them.
#[derive(Debug)]
pub struct Worker<E, F> {
    lanes: Vec<Lane<E>>,
    batch: ActingBatch,
    forward: F,
    layout: Arc<UnrollLayout>,
    demonstration_noise: f32,
    /// What the current unroll is made with; none before the first directive.
    directive: Option<Arc<Directive>>,
}

impl<E: Environment, F: ForwardPass> Worker<E, F> {
    /// Resets every environment.
    ///
    /// `demonstration_noise` is the standard deviation around the servo action when the learner asks for
    /// demonstrations. The environments are numbered from `first` on; `seed` and its number are the source of the noise
    /// of an environment's latents and actions.
    pub fn new(
        environments: Vec<E>,
        forward: F,
        layout: Arc<UnrollLayout>,
        demonstration_noise: f32,
        first: u32,
        seed: u64,
    ) -> Self {
        let mut batch = ActingBatch::new(environments.len(), ActingSizes::from(layout.shape()));
        let lanes = environments
            .into_iter()
            .zip(first..)
            .enumerate()
            .map(|(index, (environment, number))| Lane::new(environment, number, seed, &layout, &mut batch.row(index)))
            .collect();
        Self { lanes, batch, forward, layout, demonstration_noise, directive: None }
    }

    /// Acts by the newest directive and hands every full unroll to `unrolls`, until the mailbox is closed or nobody
    /// takes unrolls any more. The environments stand still until every unroll of the last round is answered for, and
    /// then as `pace` says.
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
                tracing::debug_span!("rollout", environments = self.lanes.len(), version = directive.version)
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

    /// Takes a directive for the next unroll.
    ///
    /// # Errors
    /// Parameters that do not fit.
    pub fn adopt(&mut self, directive: &Arc<Directive>) -> Result<(), Error> {
        if self.directive.as_ref().is_some_and(|current| Arc::ptr_eq(current, directive)) {
            return Ok(());
        }
        if directive.behaviour == Behaviour::Policy {
            self.forward.load(&directive.parameters)?;
        }
        self.directive = Some(Arc::clone(directive));
        Ok(())
    }

    /// One unroll of every environment; `None`, and the unrolls' beginnings are lost, when `stopped` says so.
    ///
    /// # Errors
    /// A failing forward pass.
    pub fn unroll(
        &mut self,
        stopped: &dyn Fn() -> bool,
        progress: &Progress,
    ) -> Result<Option<Vec<FinishedUnroll>>, Error> {
        let length = self.layout.shape().length;
        for t in 0..length {
            if stopped() {
                return Ok(None);
            }
            self.observe(t)?;
            self.act()?;
            self.step(t, progress);
        }
        self.observe(length)?;
        Ok(Some(self.finish()))
    }

    fn observe(&mut self, t: usize) -> Result<(), Error> {
        for (index, lane) in self.lanes.iter_mut().enumerate() {
            lane.write_observation(t, &mut self.batch.row(index))?;
        }
        Ok(())
    }

    fn act(&mut self) -> Result<(), Error> {
        for (index, lane) in self.lanes.iter_mut().enumerate() {
            lane.draw_latent_noise(&mut self.batch.row(index));
        }
        if self.demonstrates() {
            self.demonstrate();
            return Ok(());
        }
        self.forward.forward(&mut self.batch)
    }

    fn step(&mut self, t: usize, progress: &Progress) {
        let (mut steps, mut episodes) = (0, 0);
        for (index, lane) in self.lanes.iter_mut().enumerate() {
            let mut row = self.batch.row(index);
            if lane.waits() {
                // The row stays as empty as it was made.
                row.forget();
            } else if lane.at_episode_end() {
                lane.pass(t, &row);
                lane.begin_episode(&mut row);
            } else {
                lane.step(t, &mut row);
                steps += 1;
                episodes += u64::from(lane.at_episode_end());
            }
        }
        progress.steps.fetch_add(steps, Ordering::Relaxed);
        progress.episodes.fetch_add(episodes, Ordering::Relaxed);
    }

    fn finish(&mut self) -> Vec<FinishedUnroll> {
        let (learner_epoch, version, behaviour) =
            self.directive.as_ref().map_or((0, 0, Behaviour::Policy), |directive| {
                (directive.learner_epoch, directive.version, directive.behaviour)
            });
        let (lanes, batch, layout) = (&mut self.lanes, &mut self.batch, &self.layout);
        lanes
            .iter_mut()
            .enumerate()
            .map(|(index, lane)| {
                let (payload, episodes) = lane.take_unroll(layout);
                let task = lane.task();
                if lane.at_episode_end() {
                    lane.begin_episode(&mut batch.row(index));
                }
                let environment = lane.number();
                FinishedUnroll { payload, learner_epoch, version, behaviour, episodes, environment, task, ticket: None }
            })
            .collect()
    }

    fn demonstrates(&self) -> bool {
        self.directive.as_ref().is_some_and(|directive| directive.behaviour == Behaviour::Demonstration)
    }

    /// The servo action as the mean. It has neither latent nor memory: z stays 0, so z_{t−1} is 0 throughout.
    fn demonstrate(&mut self) {
        for (index, lane) in self.lanes.iter().enumerate() {
            let mut row = self.batch.row(index);
            row.decide(|mean| lane.servo_action(mean), self.demonstration_noise);
            row.latent.fill(0.0);
            row.forget();
        }
    }
}

#[cfg(test)]
mod tests;
