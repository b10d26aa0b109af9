//! Whether the trainer moves.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// When the trainer last moved. It moves at every gradient step, and every half second while it waits for a batch.
#[derive(Debug)]
pub struct Heartbeat {
    origin: Instant,
    /// Milliseconds from the origin to the last movement.
    last: AtomicU64,
}

impl Default for Heartbeat {
    /// It moves now.
    fn default() -> Self {
        Self { origin: Instant::now(), last: AtomicU64::new(0) }
    }
}

impl Heartbeat {
    /// Notes that the trainer moves.
    pub fn beat(&self) {
        self.last.store(self.origin.elapsed().as_millis() as u64, Ordering::Relaxed);
    }

    /// The time since the last movement.
    pub fn silence(&self) -> Duration {
        self.origin.elapsed().saturating_sub(Duration::from_millis(self.last.load(Ordering::Relaxed)))
    }
}
