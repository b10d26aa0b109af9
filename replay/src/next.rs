//! The result of waiting for a batch.

use crate::batch::Batch;

/// The result of waiting for a batch.
#[derive(Debug)]
pub enum Next {
    /// A batch.
    Batch(Batch),
    /// The time has elapsed.
    Elapsed,
    /// The batcher is closed.
    Closed,
}

impl Next {
    /// The batch, if there is one.
    pub fn batch(&self) -> Option<&Batch> {
        match self {
            Self::Batch(batch) => Some(batch),
            Self::Elapsed | Self::Closed => None,
        }
    }
}
