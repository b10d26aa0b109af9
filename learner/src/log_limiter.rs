//! Limits log lines about a peer to one a minute, so that a faulty peer cannot flood the log.

use std::collections::HashMap;
use std::hash::Hash;
use std::time::{Duration, Instant};

use parking_lot::Mutex;

/// The time between two lines about a peer.
const QUIET: Duration = Duration::from_secs(60);
/// Peers that are remembered. If more peers cause lines within a minute, the further ones are not logged.
const CAPACITY: usize = 1024;

/// When each peer was last logged, and how many lines about it were left out since.
#[derive(Debug)]
pub(crate) struct LogLimiter<K> {
    peers: Mutex<HashMap<K, (Instant, u64)>>,
}

impl<K> Default for LogLimiter<K> {
    fn default() -> Self {
        Self { peers: Mutex::default() }
    }
}

impl<K: Eq + Hash> LogLimiter<K> {
    /// Whether to log a line about this peer now: `Some`, with the number of lines left out before it, once a minute.
    pub(crate) fn due(&self, peer: K) -> Option<u64> {
        self.due_at(peer, Instant::now())
    }

    fn due_at(&self, peer: K, now: Instant) -> Option<u64> {
        let mut peers = self.peers.lock();
        if let Some((last, unreported)) = peers.get_mut(&peer) {
            if now.duration_since(*last) < QUIET {
                *unreported += 1;
                return None;
            }
            *last = now;
            return Some(std::mem::take(unreported));
        }
        if peers.len() >= CAPACITY {
            peers.retain(|_, (last, _)| now.duration_since(*last) < QUIET);
        }
        if peers.len() >= CAPACITY {
            return None;
        }
        peers.insert(peer, (now, 0));
        Some(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_peer_is_logged_once_a_minute_and_the_other_lines_are_counted() {
        let (log_limiter, start) = (LogLimiter::default(), Instant::now());
        assert_eq!(log_limiter.due_at(7, start), Some(0));
        assert_eq!(log_limiter.due_at(7, start + QUIET / 2), None);
        assert_eq!(log_limiter.due_at(8, start + QUIET / 2), Some(0), "another peer has its own minute");
        assert_eq!(log_limiter.due_at(7, start + QUIET), Some(1));
    }

    #[test]
    fn memory_is_bounded_and_recovers() {
        let (log_limiter, start) = (LogLimiter::default(), Instant::now());
        for peer in 0..5000 {
            log_limiter.due_at(peer, start);
        }
        assert_eq!(log_limiter.peers.lock().len(), CAPACITY);
        assert_eq!(log_limiter.due_at(5000, start), None);
        assert_eq!(log_limiter.due_at(5000, start + QUIET), Some(0));
    }
}
