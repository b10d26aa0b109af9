//! The store of sequences from which off-policy learning samples.

use std::sync::Arc;

use comic_proto::UnrollLayout;
use rand::Rng;
use rand::seq::index;

use crate::batch::Batch;
use crate::unrolls::Unrolls;

/// A store that is too large for this machine, or too small for a minibatch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum StoreError {
    /// The store would need more memory than it may use.
    #[error("a replay of {steps} environment steps takes {needed} bytes, and {limit} are allowed: make it smaller")]
    Memory {
        /// Environment steps.
        steps: usize,
        /// Bytes that it needs.
        needed: u64,
        /// Bytes that it may use.
        limit: u64,
    },
    /// The store has room for fewer sequences than a minibatch has.
    #[error(
        "a replay of {steps} environment steps has {capacity} sequences, and a minibatch {minibatch}: make it larger"
    )]
    Small {
        /// Environment steps.
        steps: usize,
        /// Sequences that fit.
        capacity: usize,
        /// Sequences of a minibatch.
        minibatch: usize,
    },
}

/// Sequences, which are unrolls, with the oldest overwritten first. Memory is allocated once; the system commits it when it is
/// first written.
///
/// A batch is handed to the trainer once, in one batch. How often it is sampled is not limited.
#[derive(Debug)]
pub struct Store {
    sequences: Unrolls,
    tasks: Vec<usize>,
    /// Sequences inserted since the beginning. Sequence n is in slot n mod capacity.
    inserted: u64,
    /// Sequences sampled since the beginning.
    sampled: u64,
}

/// Sequences that were sampled. It is reused from sample to sample.
#[derive(Debug)]
pub struct Sample {
    /// The sequences, B of them.
    pub unrolls: Unrolls,
    /// The task of each sequence, `[B]`.
    pub tasks: Vec<usize>,
}

impl Store {
    /// An empty store for at most so many environment steps, in at most `limit` bytes.
    ///
    /// # Errors
    /// [`StoreError`], if it would need more, or holds fewer sequences than a minibatch.
    pub fn new(layout: Arc<UnrollLayout>, steps: usize, minibatch: usize, limit: u64) -> Result<Self, StoreError> {
        let capacity = steps / layout.shape().length.max(1);
        if capacity < minibatch.max(1) {
            return Err(StoreError::Small { steps, capacity, minibatch });
        }
        let needed = capacity as u64 * layout.size() as u64;
        if needed > limit {
            return Err(StoreError::Memory { steps, needed, limit });
        }
        Ok(Self { sequences: Unrolls::new(layout, capacity), tasks: vec![0; capacity], inserted: 0, sampled: 0 })
    }

    /// Sequences that fit.
    pub fn capacity(&self) -> usize {
        self.tasks.len()
    }

    /// Sequences that are there.
    pub fn len(&self) -> usize {
        usize::try_from(self.inserted).map_or(self.capacity(), |inserted| inserted.min(self.capacity()))
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.inserted == 0
    }

    /// Sequences inserted and sampled since the beginning.
    pub fn counts(&self) -> (u64, u64) {
        (self.inserted, self.sampled)
    }

    /// Copies every unroll of a batch. The oldest sequences make room.
    pub fn insert(&mut self, batch: &Batch) {
        for (unroll, task) in batch.tasks().into_iter().enumerate() {
            let slot = (self.inserted % self.capacity() as u64) as usize;
            self.sequences.copy(slot, batch.as_unrolls(), unroll);
            self.tasks[slot] = task;
            self.inserted += 1;
        }
    }

    /// Copies as many sequences as the sample has into it: each sequence of the store is equally likely, and none comes twice.
    /// It is `false`, and the sample unchanged, if the store holds fewer.
    pub fn sample(&mut self, sample: &mut Sample, random: &mut impl Rng) -> bool {
        let count = sample.tasks.len();
        if self.len() < count {
            return false;
        }
        for (place, slot) in index::sample(random, self.len(), count).into_iter().enumerate() {
            sample.unrolls.copy(place, &self.sequences, slot);
            sample.tasks[place] = self.tasks[slot];
        }
        self.sampled += count as u64;
        true
    }
}

impl Sample {
    /// Room for `sequences` sequences.
    pub fn new(layout: Arc<UnrollLayout>, sequences: usize) -> Self {
        Self { unrolls: Unrolls::new(layout, sequences), tasks: vec![0; sequences] }
    }
}
