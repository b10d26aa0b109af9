//! Publishing versions of the parameters.

use bytes::Bytes;
use comic_experiment::{Experiment, PublishedNumber};
use comic_networks::to_bfloat16;
use comic_replay::{Batcher, Phase};

use crate::error::Result;
use crate::publish::Publisher;
use crate::train::state::State;

/// Where actors and batcher learn which version is the newest.
#[derive(Debug)]
pub(super) struct Versions {
    batcher: Batcher,
    publisher: Publisher,
    lockstep: bool,
    number: PublishedNumber,
    /// Unrolls of versions before this one are superseded.
    oldest: u64,
}

impl Versions {
    pub(super) fn new(batcher: Batcher, publisher: Publisher, experiment: &Experiment) -> Self {
        let (lockstep, number) = (experiment.unroll.lockstep, experiment.learner.published_number);
        Self { batcher, publisher, lockstep, number, oldest: 0 }
    }

    /// Publishes the online policy as the next version. From now on it is the target network, with which actors act. Statistics
    /// of the observations that were collected since the last version take effect.
    ///
    /// # Errors
    /// When the device refuses.
    pub(super) fn publish(&self, state: &mut State) -> Result<()> {
        let _publish = tracing::debug_span!("publish", version = state.progress.version + 1).entered();
        state.set_normaliser()?;
        state.target = Bytes::from(state.algorithm.policy_parameters()?);
        state.progress.version += 1;
        self.announce(state)
    }

    /// In lockstep, publishes the same parameters as the next version. There, actors make one unroll of each environment
    /// with each version, so they need a version after every batch.
    ///
    /// # Errors
    /// As of [`announce`](Self::announce).
    pub(super) fn repeat(&self, state: &mut State) -> Result<()> {
        if self.lockstep {
            state.progress.version += 1;
            self.announce(state)?;
        }
        Ok(())
    }

    /// Tells actors and batcher of the newest version, for instance after a restart.
    ///
    /// # Errors
    /// When the parameters are damaged, for instance in a checkpoint.
    pub(super) fn announce(&self, state: &State) -> Result<()> {
        let parameters = match self.number {
            PublishedNumber::Float32 => state.target.clone(),
            PublishedNumber::Bfloat16 => Bytes::from(to_bfloat16(&state.target)?),
        };
        let (epoch, version, oldest) = (state.progress.epoch, state.progress.version, self.oldest);
        self.batcher.set_phase(Phase { epoch, version, oldest });
        self.publisher.publish(version, &parameters);
        Ok(())
    }

    /// With the next version, unrolls of all versions so far are superseded.
    pub(super) fn supersede(&mut self, state: &State) {
        self.oldest = state.progress.version + 1;
    }
}
