//! The batcher of one learner: the rules of `replay/src/batcher.rs` for unrolls that are versions only.

use std::collections::VecDeque;

/// An unroll on its way from a worker to a batch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Unroll {
    pub(super) worker: usize,
    /// The version of the parameters that it was made with.
    pub(super) version: u64,
}

#[derive(Debug)]
pub(super) struct Batcher {
    unrolls: usize,
    max_versions_late: u64,
    version: u64,
    /// The versions of the unrolls in the batch that the trainer gets next.
    next: Option<Vec<u64>>,
    open: Option<Vec<u64>>,
    /// Buffers of a batch that are empty.
    free: usize,
    /// Slots of `next` and `open` that are empty.
    slots: usize,
    /// Unrolls that wait for a slot: at most one for each stream.
    queue: VecDeque<Unroll>,
    /// Unrolls that became stale in a batch.
    dropped: u64,
}

impl Batcher {
    pub(super) fn new(unrolls: usize, ahead: usize, max_versions_late: u64) -> Self {
        Self {
            unrolls,
            max_versions_late,
            version: 0,
            next: None,
            open: Some(Vec::with_capacity(unrolls)),
            free: ahead,
            slots: unrolls,
            queue: VecDeque::new(),
            dropped: 0,
        }
    }

    pub(super) fn set_version(&mut self, version: u64) {
        self.version = version;
    }

    pub(super) fn is_stale(&self, version: u64) -> bool {
        self.version.saturating_sub(version) > self.max_versions_late
    }

    /// Lets an unroll that is not stale wait for a slot.
    pub(super) fn enqueue(&mut self, unroll: Unroll) {
        self.queue.push_back(unroll);
    }

    pub(super) fn waiting(&self) -> usize {
        self.queue.len()
    }

    /// Unrolls that became stale in a batch so far.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped
    }

    /// The unroll that has waited longest, and whether it is in a batch; `None` if no slot is free or none waits. One that
    /// became stale while it waited needs no slot.
    pub(super) fn admit(&mut self) -> Option<(Unroll, bool)> {
        if self.slots == 0 {
            return None;
        }
        let unroll = self.queue.pop_front()?;
        if self.is_stale(unroll.version) {
            return Some((unroll, false));
        }
        let full = self.unrolls;
        let batch = [&mut self.next, &mut self.open].into_iter().flatten().find(|batch| batch.len() < full)?;
        batch.push(unroll.version);
        self.slots -= 1;
        self.settle();
        Some((unroll, true))
    }

    /// The versions of the next batch, if it is full after stale unrolls are dropped.
    pub(super) fn take(&mut self) -> Option<Vec<u64>> {
        if self.next.as_ref()?.len() < self.unrolls {
            return None;
        }
        self.drop_stale();
        let full = self.unrolls;
        let taken = self.next.take_if(|next| next.len() == full);
        self.settle();
        taken
    }

    /// Frees the memory of a batch that was taken.
    pub(super) fn trained(&mut self) {
        self.free += 1;
        self.settle();
    }

    fn drop_stale(&mut self) {
        let oldest = self.version.saturating_sub(self.max_versions_late);
        let mut removed = 0;
        for batch in [&mut self.next, &mut self.open].into_iter().flatten() {
            let before = batch.len();
            batch.retain(|version| *version >= oldest);
            removed += before - batch.len();
        }
        // The rest of the open batch fills the next one.
        if let (Some(next), Some(open)) = (&mut self.next, &mut self.open) {
            let moved = open.len().min(self.unrolls - next.len());
            next.extend(open.drain(..moved));
        }
        self.dropped += removed as u64;
        self.slots += removed;
    }

    fn settle(&mut self) {
        if self.next.is_none() {
            let full = self.unrolls;
            self.next = self.open.take_if(|open| open.len() == full);
        }
        if self.open.is_none() && self.free > 0 {
            self.free -= 1;
            self.open = Some(Vec::with_capacity(self.unrolls));
            self.slots += self.unrolls;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fill(batcher: &mut Batcher, versions: impl IntoIterator<Item = u64>) -> usize {
        versions.into_iter().for_each(|version| batcher.enqueue(Unroll { worker: 0, version }));
        std::iter::from_fn(|| batcher.admit()).count()
    }

    #[test]
    fn without_a_batch_ahead_nothing_is_accepted_while_one_is_trained_on() {
        let mut batcher = Batcher::new(2, 0, 9);
        assert_eq!(fill(&mut batcher, [0; 5]), 2);
        assert_eq!(batcher.take(), Some(vec![0; 2]));
        assert_eq!(fill(&mut batcher, []), 0);
        batcher.trained();
        assert_eq!((fill(&mut batcher, []), batcher.waiting()), (2, 1));
    }

    #[test]
    fn a_batch_ahead_fills_while_one_is_trained_on() {
        let mut batcher = Batcher::new(2, 1, 9);
        assert_eq!(fill(&mut batcher, [0; 7]), 4);
        assert_eq!(batcher.take(), Some(vec![0; 2]));
        assert_eq!(fill(&mut batcher, []), 0);
        batcher.trained();
        assert_eq!(fill(&mut batcher, []), 2);
    }

    #[test]
    fn stale_unrolls_leave_a_batch_and_a_full_batch_has_none() {
        let mut batcher = Batcher::new(2, 1, 1);
        assert_eq!(fill(&mut batcher, [1, 3, 1]), 3);
        batcher.set_version(3);
        assert_eq!((batcher.take(), batcher.dropped()), (None, 2));
        assert_eq!(fill(&mut batcher, [2]), 1);
        assert_eq!(batcher.take(), Some(vec![3, 2]));
    }

    #[test]
    fn an_unroll_that_became_stale_while_it_waited_needs_no_slot() {
        let mut batcher = Batcher::new(1, 0, 0);
        assert_eq!(fill(&mut batcher, [0, 0]), 1);
        assert!(batcher.take().is_some());
        batcher.set_version(1);
        batcher.trained();
        assert_eq!(batcher.admit().map(|(_, taken)| taken), Some(false));
        assert_eq!(fill(&mut batcher, [1]), 1);
    }
}
