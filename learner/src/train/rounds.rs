//! What the ranks decide together before each batch. A learner alone decides the same way, by itself.

use comic_replay::Batch;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::error::{Error, Result};
use crate::observe::window::Rows;
use crate::world::World;

/// What a rank says.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Said {
    /// Its batch, if it has one.
    pub(super) batch: Option<Contents>,
    /// It was told to stop.
    pub(super) stops: bool,
    /// Actors that it serves.
    pub(super) actors: u64,
    /// The fraction of the budget that is used. This and the rest are rank 0's to say.
    pub(super) used: f64,
    /// Another checkpoint is due.
    pub(super) checkpoint: bool,
    /// A line of metrics is due.
    pub(super) metrics: bool,
}

/// What is in a batch.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Contents {
    pub(super) environment_steps: u64,
    /// The task of each unroll.
    pub(super) tasks: Vec<usize>,
}

impl Contents {
    /// What is in this batch of a run with so many tasks.
    pub(super) fn of(batch: &Batch, tasks: usize) -> Self {
        let rows = Rows::of(batch, tasks);
        Self { environment_steps: rows.iter().map(|rows| rows.environment_steps).sum(), tasks: batch.tasks() }
    }
}

/// What all ranks have decided.
#[derive(Clone, Debug)]
pub(super) struct Round {
    /// The batches of all ranks together, when every rank has its own.
    pub(super) batch: Option<Contents>,
    /// A rank was told to stop.
    pub(super) stops: bool,
    /// The actors of each rank.
    pub(super) actors: Vec<u64>,
    /// The fraction of the budget that is used.
    pub(super) used: f64,
    /// A checkpoint follows the next update.
    pub(super) checkpoint: bool,
    /// A line of metrics is written now.
    pub(super) metrics: bool,
}

impl Round {
    /// What all ranks of this world have decided, from what each says. Waits for all of them.
    ///
    /// # Errors
    /// When another rank is lost.
    pub(super) fn of(world: &World, said: Said) -> Result<Self> {
        let mut said = world.exchange(said)?;
        let batches: Option<Vec<Contents>> = said.iter_mut().map(|said| said.batch.take()).collect();
        let first = said.first().cloned();
        Ok(Self {
            batch: batches.map(|batches| Contents {
                environment_steps: batches.iter().map(|batch| batch.environment_steps).sum(),
                tasks: batches.into_iter().flat_map(|batch| batch.tasks).collect(),
            }),
            stops: said.iter().any(|said| said.stops),
            actors: said.iter().map(|said| said.actors).collect(),
            used: first.as_ref().map_or(0.0, |first| first.used),
            checkpoint: first.as_ref().is_some_and(|first| first.checkpoint),
            metrics: first.as_ref().is_some_and(|first| first.metrics),
        })
    }
}

/// Checks that all ranks have `learned` the same after so many updates, bit for bit. Otherwise each would teach its actors something
/// else.
///
/// # Errors
/// [`Error::Device`] when they have not.
pub(super) fn check_equality(world: &World, learned: &[u8], updates: u64) -> Result<()> {
    if world.size() == 1 {
        return Ok(());
    }
    let digests = world.exchange(hex::encode(Sha256::digest(learned)))?;
    match digests.iter().position(|other| Some(other) != digests.first()) {
        None => Ok(()),
        Some(rank) => Err(Error::Device(format!(
            "after update {updates}, rank {rank} has learned otherwise than rank 0: all ranks need the same processors, devices and \
             learner.threads. The newest checkpoint is from before"
        ))),
    }
}
