//! Where the unrolls of gradient steps come from.

use std::fmt::Debug;

use comic_replay::Batch;
use rand_pcg::Pcg64;

use crate::algorithm::minibatch::MinibatchTensors;
use crate::error::Result;

/// Turns batches into the minibatches of gradient steps. It decides how many there are.
pub trait Experience: Debug {
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
}
