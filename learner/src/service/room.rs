//! The memory for messages that were read and are not in a batch yet.

use std::sync::Arc;

use prometheus_client::metrics::counter::Counter;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::sync::PollSemaphore;

/// Room for messages of all streams together, in bytes; a handle that can be cloned.
#[derive(Clone, Debug)]
pub(super) struct Room {
    free: Arc<Semaphore>,
    bytes: usize,
    /// Messages that lost their room because they did not arrive in time.
    late: Counter,
}

/// Room that is taken until this is dropped.
pub(super) type Taken = OwnedSemaphorePermit;

impl Room {
    /// Room for so many bytes.
    pub(super) fn new(bytes: usize, late: Counter) -> Self {
        let bytes = bytes.min(Semaphore::MAX_PERMITS);
        Self { free: Arc::new(Semaphore::new(bytes)), bytes, late }
    }

    /// Bytes that are taken.
    pub(super) fn taken(&self) -> u64 {
        self.bytes.saturating_sub(self.free.available_permits()) as u64
    }

    /// The free room, for a stream that takes parts of it.
    pub(super) fn free(&self) -> PollSemaphore {
        PollSemaphore::new(self.free.clone())
    }

    /// The counter of messages that lost their room.
    pub(super) fn late(&self) -> Counter {
        self.late.clone()
    }
}
