//! A log that stays readable when a peer misbehaves at full speed.

use std::collections::HashMap;
use std::hash::Hash;
use std::time::{Duration, Instant};

use parking_lot::Mutex;

/// Silence after a complaint about a peer.
const QUIET: Duration = Duration::from_secs(60);
/// Peers remembered. Were so many to misbehave within a minute, the log would have nothing more to tell.
const REMEMBERED: usize = 1024;

/// When each peer was last complained about, and how often it deserved it since.
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
    /// How many log_limiter about this peer went unreported before this one, if it is to be reported: once a minute.
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
        if peers.len() >= REMEMBERED {
            peers.retain(|_, (last, _)| now.duration_since(*last) < QUIET);
        }
        if peers.len() >= REMEMBERED {
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
    fn a_peer_is_complained_about_once_a_minute_and_the_rest_is_counted() {
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
        assert_eq!(log_limiter.peers.lock().len(), REMEMBERED);
        assert_eq!(log_limiter.due_at(5000, start), None);
        assert_eq!(log_limiter.due_at(5000, start + QUIET), Some(0));
    }
}
