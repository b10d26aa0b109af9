//! Where the unrolls of gradient steps come from.

use std::fmt::Debug;
use std::time::Duration;

use comic_replay::{Batch, Batcher, Next};
use rand_pcg::Pcg64;

use crate::algorithm::minibatch::MinibatchTensors;
use crate::algorithm::replay::Replay;
use crate::error::Result;

/// Turns batches into the minibatches of gradient steps. It decides which unrolls the trainer gets, and how many gradient steps
/// follow.
pub trait Experience: Debug {
    /// The next unrolls to take in, if there are some within this time.
    fn next(&mut self, batcher: &Batcher, patience: Duration) -> Next;

    /// Takes a batch in. Returns how many gradient steps are due.
    ///
    /// # Errors
    /// When the device refuses.
    fn take(&mut self, batch: &Batch, random: &mut Pcg64) -> Result<usize>;

    /// The minibatch of gradient step number `step` since the last batch, which is below what [`take`](Self::take) returned.
    ///
    /// # Errors
    /// When the device refuses.
    fn minibatch(&mut self, step: usize, random: &mut Pcg64) -> Result<MinibatchTensors>;

    /// Frees what the gradient steps of the last batch needed.
    fn release(&mut self) {}

    /// The replay, if it is one: it is reported and saved.
    fn replay(&mut self) -> Option<&mut Replay> {
        None
    }
}

impl Experience for Replay {
    fn next(&mut self, batcher: &Batcher, patience: Duration) -> Next {
        Replay::next(self, batcher, patience)
    }

    fn take(&mut self, batch: &Batch, _: &mut Pcg64) -> Result<usize> {
        Ok(self.insert(batch))
    }

    fn minibatch(&mut self, _: usize, random: &mut Pcg64) -> Result<MinibatchTensors> {
        self.sample(random)
    }

    fn replay(&mut self) -> Option<&mut Replay> {
        Some(self)
    }
}
