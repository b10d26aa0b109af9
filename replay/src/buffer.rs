//! The memory of a batch, and which of its slots are in use.

use std::sync::Arc;

use comic_proto::v1::UnrollHeader;
use comic_proto::{Pieces, UnrollLayout};

use crate::unrolls::Unrolls;

/// The unrolls of a batch with their headers. A buffer is allocated once and then reused.
#[derive(Debug)]
pub(crate) struct Buffer {
    pub(crate) unrolls: Unrolls,
    /// One header per slot. A free slot has the header of an earlier unroll.
    pub(crate) headers: Vec<UnrollHeader>,
    filled: Vec<bool>,
    /// The slots in use, that of the oldest unroll first.
    arrivals: Vec<usize>,
}

impl Buffer {
    pub(crate) fn new(layout: Arc<UnrollLayout>, unrolls: usize) -> Self {
        Self {
            unrolls: Unrolls::new(layout, unrolls),
            headers: vec![UnrollHeader::default(); unrolls],
            filled: vec![false; unrolls],
            arrivals: Vec::with_capacity(unrolls),
        }
    }

    /// Number of slots in use.
    pub(crate) fn len(&self) -> usize {
        self.arrivals.len()
    }

    /// Whether every slot is in use.
    pub(crate) fn is_full(&self) -> bool {
        self.arrivals.len() == self.filled.len()
    }

    /// Whether the unrolls are in the first slots in the order in which they arrived.
    pub(crate) fn is_in_order(&self) -> bool {
        self.arrivals.iter().enumerate().all(|(place, slot)| place == *slot)
    }

    /// The first free slot; the number of slots if there is none.
    pub(crate) fn first_free(&self) -> usize {
        self.filled.iter().position(|filled| !filled).unwrap_or(self.filled.len())
    }

    /// Whether this slot exists and is free.
    pub(crate) fn is_free(&self, slot: usize) -> bool {
        self.filled.get(slot) == Some(&false)
    }

    /// The task of each unroll.
    pub(crate) fn tasks(&self) -> impl Iterator<Item = u32> {
        self.arrivals.iter().filter_map(|slot| self.headers.get(*slot)).map(|header| header.task)
    }

    /// Frees every slot.
    pub(crate) fn clear(&mut self) {
        self.filled.fill(false);
        self.arrivals.clear();
        self.unrolls.set_len(self.filled.len());
    }

    /// Copies an unroll into a free slot. The payload must have the size of the layout.
    pub(crate) fn put(&mut self, slot: usize, header: UnrollHeader, payload: &Pieces) {
        self.unrolls.put(slot, payload);
        self.occupy(slot, header);
    }

    /// Frees the slots of the unrolls that are not `kept`. Returns the tasks of the removed unrolls.
    pub(crate) fn retain(&mut self, kept: impl Fn(&UnrollHeader) -> bool) -> Vec<u32> {
        let mut removed = Vec::new();
        let Self { headers, filled, arrivals, .. } = self;
        arrivals.retain(|slot| {
            let header = &headers[*slot];
            filled[*slot] = kept(header);
            if !filled[*slot] {
                removed.push(header.task);
            }
            filled[*slot]
        });
        removed
    }

    /// Moves the oldest unrolls of `other`, at most `count`, into the first free slots of this buffer.
    pub(crate) fn move_from(&mut self, other: &mut Self, count: usize) {
        let count = count.min(other.len()).min(self.filled.len() - self.len());
        for slot in other.arrivals.drain(..count) {
            other.filled[slot] = false;
            let free = self.first_free();
            self.unrolls.copy(free, &other.unrolls, slot);
            self.occupy(free, std::mem::take(&mut other.headers[slot]));
        }
    }

    fn occupy(&mut self, slot: usize, header: UnrollHeader) {
        self.headers[slot] = header;
        self.filled[slot] = true;
        self.arrivals.push(slot);
    }
}
