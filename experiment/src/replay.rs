//! The replay of an off-policy algorithm, in the words of Reverb: a table, and a rate limiter.

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, ensure};

/// A table of sequences, sampled uniformly, the oldest removed first; and a rate limiter, which lets neither actors nor learner
/// run ahead. (A) is the published agent `svg0_prior` of the paper's group; (D) a decision of this project.
///
/// A sequence is an unroll. Numbers of environment steps are turned into sequences: divided by `unroll.length`, rounded down.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Replay {
    /// Most environment steps in the table (A: a million items).
    pub max_size: usize,
    /// Environment steps in the table before the first sample (D; A: 1,000 items).
    pub min_size: usize,
    /// Sequences sampled for each sequence inserted (A: 32 with many actors).
    pub samples_per_insert: f64,
    /// Samples by which the learner may be ahead of that ratio, or behind it, before it waits or the actors do. 0 is a tenth of
    /// the minimum size, times `samples_per_insert` (A), and enough for both sides to move.
    pub error_buffer: f64,
    /// Most memory of the table, MiB. 0 is half of what this process may use: its cgroup's limit, or the machine's memory.
    pub memory_mib: u64,
    /// Whether checkpoints have the table. There is one copy, that of the newest checkpoint.
    pub save: bool,
}

impl Default for Replay {
    fn default() -> Self {
        Self {
            max_size: 1_000_000,
            min_size: 100_000,
            samples_per_insert: 32.0,
            error_buffer: 0.0,
            memory_mib: 0,
            save: false,
        }
    }
}

impl Replay {
    /// Sequences of `length` steps, of which a minibatch has `minibatch`.
    pub(crate) fn check(&self, length: usize, minibatch: usize) -> Result<(), Fault> {
        let Self { max_size, min_size, samples_per_insert, error_buffer, .. } = self;
        ensure("replay.max_size", max_size, *max_size <= 1 << 32, "must be at most 4294967296")?;
        let least = minibatch * length;
        let remedy = format!("must be a minibatch at least, which has {least} environment steps");
        ensure("replay.max_size", max_size, *max_size >= least, remedy)?;
        ensure("replay.min_size", min_size, min_size <= max_size, "must be at most replay.max_size")?;
        let (samples, buffer) = (*samples_per_insert, *error_buffer);
        ensure("replay.samples_per_insert", samples, (1e-3..=1e4).contains(&samples), "must be 0.001 to 10000")?;
        let least = samples.max(minibatch as f64);
        let remedy = format!("must be 0, or {least} at least: with less, both sides would wait for ever");
        ensure("replay.error_buffer", buffer, buffer == 0.0 || (buffer >= least && buffer <= 1e9), remedy)
    }

    /// Sequences in the table before the first sample: at least a minibatch.
    pub fn min_sequences(&self, length: usize, minibatch: usize) -> usize {
        (self.min_size / length.max(1)).max(minibatch)
    }

    /// The error buffer in sequences, for a minibatch of so many.
    pub fn error_buffer(&self, length: usize, minibatch: usize) -> f64 {
        if self.error_buffer > 0.0 {
            return self.error_buffer;
        }
        let tenth = 0.1 * self.min_sequences(length, minibatch) as f64 * self.samples_per_insert;
        tenth.max(minibatch as f64).max(self.samples_per_insert)
    }
}
