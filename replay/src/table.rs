//! The table of unrolls from which off-policy learning samples.

use std::sync::Arc;

use comic_proto::UnrollLayout;
use rand::Rng;
use rand::seq::index;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::unrolls::Unrolls;

pub use saved::ReadTableError;

mod saved;

/// The sizes of a table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TableConfig {
    /// Greatest number of items.
    pub max_size: usize,
    /// Items of a sample; the table must have room for them.
    pub sample_size: usize,
    /// Bytes that the table may use.
    pub memory: u64,
}

/// A table that is too large for this machine, or too small for a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum TableError {
    /// The table would need more memory than it may use.
    #[error("a table of {max_size} unrolls takes {needed} bytes, and {limit} are allowed: make it smaller")]
    Memory {
        /// Greatest number of items.
        max_size: usize,
        /// Bytes that it needs.
        needed: u64,
        /// Bytes that it may use.
        limit: u64,
    },
    /// The table has room for fewer items than a sample has.
    #[error("a table has {max_size} unrolls, and a minibatch {sample_size}: make the table larger")]
    Small {
        /// Greatest number of items.
        max_size: usize,
        /// Items of a sample.
        sample_size: usize,
    },
}

/// Items inserted and sampled since the beginning of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counts {
    /// Items inserted.
    pub inserted: u64,
    /// Items sampled; an item counts each time.
    pub sampled: u64,
}

/// A table in the sense of Reverb. Its items are unrolls. The sampler is uniform, without repeats inside one sample.
/// The remover is first in, first out: at `max_size` items, each insert evicts the oldest one.
///
/// Its memory is allocated and committed when it is made, and never grows.
#[derive(Debug)]
pub struct Table {
    /// Item number n, counted from the beginning of the run, is in slot n mod `max_size`.
    unrolls: Unrolls,
    /// The task of the item in each slot.
    tasks: Vec<u32>,
    /// Items that are there: those with the numbers from `inserted − len` to `inserted − 1`.
    len: usize,
    counts: Counts,
}

/// Items that were sampled. It is reused from sample to sample.
#[derive(Debug)]
pub struct Sample {
    /// The items, N of them.
    pub unrolls: Unrolls,
    /// The task of each item, `[N]`.
    pub tasks: Vec<usize>,
    /// The age of each item, `[N]`: items that were inserted after it.
    pub ages: Vec<u64>,
}

impl Table {
    /// An empty table.
    ///
    /// # Errors
    /// [`TableError`], if it would need more memory than it may use, or holds fewer items than a sample.
    pub fn new(layout: Arc<UnrollLayout>, config: TableConfig) -> Result<Self, TableError> {
        let TableConfig { max_size, sample_size, memory: limit } = config;
        if max_size < sample_size.max(1) {
            return Err(TableError::Small { max_size, sample_size });
        }
        let needed = Self::memory(&layout, max_size);
        if needed > limit {
            return Err(TableError::Memory { max_size, needed, limit });
        }
        let mut unrolls = Unrolls::new(layout, max_size);
        unrolls.commit();
        // Not 0, since zeroed memory is committed only when it is written.
        Ok(Self { unrolls, tasks: vec![u32::MAX; max_size], len: 0, counts: Counts::default() })
    }

    /// Bytes that a table of this size needs.
    pub fn memory(layout: &UnrollLayout, max_size: usize) -> u64 {
        (layout.size() as u64).saturating_add(size_of::<u32>() as u64).saturating_mul(max_size as u64)
    }

    /// Greatest number of items.
    pub fn max_size(&self) -> usize {
        self.tasks.len()
    }

    /// Items that are there.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is no item.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Items inserted and sampled since the beginning.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// Items evicted since the beginning, the oldest first.
    pub fn evicted(&self) -> u64 {
        self.counts.inserted - self.len as u64
    }

    /// Copies unrolls of these tasks, `[N]`, into the table, in their order. The oldest items make room.
    ///
    /// # Panics
    /// If the unrolls have another layout.
    pub fn insert(&mut self, unrolls: &Unrolls, tasks: &[usize]) {
        for (unroll, task) in (0..unrolls.len()).zip(tasks) {
            let slot = self.slot(self.counts.inserted);
            self.unrolls.copy(slot, unrolls, unroll);
            self.tasks[slot] = *task as u32;
            self.counts.inserted += 1;
            self.len = self.max_size().min(self.len + 1);
        }
    }

    /// Copies as many items as the sample has into it: each item of the table is equally likely, and none comes twice.
    /// It is `false`, and the sample unchanged, if the table holds fewer.
    ///
    /// # Panics
    /// If the sample has another layout.
    pub fn sample(&mut self, sample: &mut Sample, random: &mut impl Rng) -> bool {
        let n = sample.unrolls.len();
        if self.len < n {
            return false;
        }
        // An item is drawn by its age, so the draw does not depend on the slots.
        for (place, age) in index::sample(random, self.len, n).into_iter().enumerate() {
            let slot = self.slot(self.counts.inserted - 1 - age as u64);
            sample.unrolls.copy(place, &self.unrolls, slot);
            sample.tasks[place] = self.tasks[slot] as usize;
            sample.ages[place] = age as u64;
        }
        self.counts.sampled += n as u64;
        true
    }

    /// The slot of the item with this number.
    fn slot(&self, number: u64) -> usize {
        (number % self.max_size() as u64) as usize
    }
}

impl Sample {
    /// Room for `n` items.
    pub fn new(layout: Arc<UnrollLayout>, n: usize) -> Self {
        Self { unrolls: Unrolls::new(layout, n), tasks: vec![0; n], ages: vec![0; n] }
    }
}
