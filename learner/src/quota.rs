//! Limits how often something happens, for each key of its own.

use std::collections::HashMap;
use std::hash::Hash;
use std::time::{Duration, Instant};

use parking_lot::Mutex;

/// Keys that are remembered. A key is forgotten when its quota is full again.
const CAPACITY: usize = 65_536;

/// So many events at once, and then one in each interval (the generic cell rate algorithm).
#[derive(Debug)]
pub(crate) struct Quota<K> {
    at_once: u32,
    interval: Duration,
    /// When the quota of a key is full again.
    full_at: Mutex<HashMap<K, Instant>>,
}

impl<K: Eq + Hash> Quota<K> {
    pub(crate) fn new(at_once: u32, interval: Duration) -> Self {
        Self { at_once, interval, full_at: Mutex::default() }
    }

    /// Whether the quota of this key allows an event now. Then it is counted.
    pub(crate) fn take(&self, key: K) -> bool {
        self.take_at(key, Instant::now())
    }

    fn take_at(&self, key: K, now: Instant) -> bool {
        let mut full_at = self.full_at.lock();
        if full_at.len() >= CAPACITY {
            full_at.retain(|_, full| *full > now);
        }
        let full = full_at.get(&key).map_or(now, |full| (*full).max(now)) + self.interval;
        let allowed = full - now <= self.interval * self.at_once;
        if allowed && (full_at.len() < CAPACITY || full_at.contains_key(&key)) {
            full_at.insert(key, full);
            return true;
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn so_many_at_once_and_then_one_in_each_interval_for_each_key() {
        let (interval, start) = (Duration::from_secs(2), Instant::now());
        let quota = Quota::new(3, interval);
        let at = |key, now| quota.take_at(key, now);
        assert!(at('a', start) && at('a', start) && at('a', start) && !at('a', start));
        assert!(at('b', start), "another key has its own quota");
        assert!(!at('a', start + interval / 2));
        assert!(at('a', start + interval) && !at('a', start + interval));
        let later = start + interval * 100;
        assert!(at('a', later) && at('a', later) && at('a', later) && !at('a', later), "no more than at first");
    }

    #[test]
    fn memory_is_bounded_and_recovers() {
        let (interval, start) = (Duration::from_secs(2), Instant::now());
        let quota = Quota::new(1, interval);
        assert!((0..CAPACITY).all(|key| quota.take_at(key, start)));
        assert!(!quota.take_at(CAPACITY, start));
        assert_eq!(quota.full_at.lock().len(), CAPACITY);
        assert!(quota.take_at(CAPACITY, start + interval * 2));
        assert_eq!(quota.full_at.lock().len(), 1);
    }
}
