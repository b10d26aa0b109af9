//! A network link that its transfers share.

use std::collections::BTreeMap;

use super::agenda::Agenda;

/// Which way bytes go; a link counts both apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Direction {
    /// To the learner.
    In,
    /// From the learner.
    Out,
}

/// Identifies a transfer on its link.
pub(super) type Key = u64;

/// All transfers progress at once, each with a speed in proportion to its weight, as TCP connections do about. Each has the
/// same progress per weight since the beginning, so a transfer ends at a progress that is known when it starts, and it is
/// enough to look at the smallest one.
#[derive(Debug)]
pub(super) struct Link<T> {
    bytes_per_second: f64,
    now: f64,
    /// Bytes per weight that a transfer would have got since the beginning.
    progress: f64,
    /// The weight of all transfers of each direction.
    weights: [f64; 2],
    delivered: [f64; 2],
    active: BTreeMap<Key, Transfer<T>>,
    /// At which progress each transfer ends; also those that were cancelled.
    ends: Agenda<Key>,
    next: Key,
}

#[derive(Debug)]
struct Transfer<T> {
    what: T,
    weight: f64,
    direction: Direction,
}

impl<T> Link<T> {
    pub(super) fn new(bytes_per_second: f64) -> Self {
        Self {
            bytes_per_second,
            now: 0.0,
            progress: 0.0,
            weights: [0.0; 2],
            delivered: [0.0; 2],
            active: BTreeMap::new(),
            ends: Agenda::new(),
            next: 0,
        }
    }

    /// Starts a transfer at the time `now`.
    pub(super) fn start(&mut self, now: f64, what: T, bytes: f64, weight: f64, direction: Direction) -> Key {
        self.advance(now);
        let key = self.next;
        self.next += 1;
        self.weights[direction as usize] += weight;
        self.ends.add(self.progress + bytes / weight, key);
        self.active.insert(key, Transfer { what, weight, direction });
        key
    }

    /// Ends a transfer before all its bytes have arrived.
    pub(super) fn cancel(&mut self, now: f64, key: Key) {
        self.advance(now);
        self.remove(key);
    }

    /// When the next transfer ends, if none starts before.
    pub(super) fn next_end(&mut self) -> Option<f64> {
        while let Some((progress, key)) = self.ends.first() {
            if self.active.contains_key(key) {
                let left = (progress - self.progress).max(0.0);
                return Some(self.now + left * self.weight() / self.bytes_per_second);
            }
            // It was cancelled.
            self.ends.take_first();
        }
        None
    }

    /// Ends the transfer of [`next_end`](Self::next_end), whose time is `now`.
    pub(super) fn end_next(&mut self, now: f64) -> Option<T> {
        self.advance(now);
        let (progress, key) = self.ends.take_first()?;
        // Exactly, whatever the clock rounds.
        self.progress = self.progress.max(progress);
        self.remove(key)
    }

    /// Bytes that have arrived until `now`, in this direction.
    pub(super) fn delivered(&mut self, now: f64, direction: Direction) -> f64 {
        self.advance(now);
        self.delivered[direction as usize]
    }

    fn weight(&self) -> f64 {
        self.weights.iter().sum()
    }

    fn advance(&mut self, now: f64) {
        if !self.active.is_empty() {
            let progress = (now - self.now) * self.bytes_per_second / self.weight();
            self.progress += progress;
            self.delivered.iter_mut().zip(self.weights).for_each(|(bytes, weight)| *bytes += progress * weight);
        }
        self.now = now;
    }

    fn remove(&mut self, key: Key) -> Option<T> {
        let Transfer { what, weight, direction } = self.active.remove(&key)?;
        self.weights[direction as usize] -= weight;
        if self.active.is_empty() {
            // Without what rounding has left.
            self.weights = [0.0; 2];
        }
        Some(what)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn end(link: &mut Link<&'static str>) -> (f64, &'static str) {
        let at = link.next_end().unwrap();
        (at, link.end_next(at).unwrap())
    }

    #[test]
    fn transfers_share_a_link_in_proportion_to_their_weights() {
        let mut link = Link::new(100.0);
        link.start(0.0, "light", 300.0, 1.0, Direction::In);
        link.start(0.0, "heavy", 300.0, 2.0, Direction::Out);
        // Two thirds of the speed for the heavy one; then the other has the link alone for its last 150 bytes.
        assert_eq!(end(&mut link), (4.5, "heavy"));
        assert_eq!(end(&mut link), (6.0, "light"));
        assert_eq!(link.delivered(9.0, Direction::In), 300.0);
        assert_eq!(link.delivered(9.0, Direction::Out), 300.0);
        assert_eq!(link.next_end(), None);
    }

    #[test]
    fn a_cancelled_transfer_leaves_its_share_to_the_others() {
        let mut link = Link::new(100.0);
        let cancelled = link.start(0.0, "cancelled", 100.0, 1.0, Direction::Out);
        link.start(0.0, "other", 200.0, 1.0, Direction::Out);
        link.cancel(1.0, cancelled);
        assert_eq!(end(&mut link), (2.5, "other"));
    }
}
