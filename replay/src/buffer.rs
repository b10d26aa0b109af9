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
    /// Number of slots in use.
    used: usize,
}

impl Buffer {
    pub(crate) fn new(layout: Arc<UnrollLayout>, unrolls: usize) -> Self {
        Self {
            unrolls: Unrolls::new(layout, unrolls),
            headers: vec![UnrollHeader::default(); unrolls],
            filled: vec![false; unrolls],
            used: 0,
        }
    }

    /// Number of slots in use.
    pub(crate) fn len(&self) -> usize {
        self.used
    }

    /// Whether every slot is in use.
    pub(crate) fn is_full(&self) -> bool {
        self.used == self.filled.len()
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
        self.filled.iter().zip(&self.headers).filter(|(filled, _)| **filled).map(|(_, header)| header.task)
    }

    /// Frees every slot.
    pub(crate) fn clear(&mut self) {
        self.filled.fill(false);
        self.used = 0;
    }

    /// Copies an unroll into a free slot. The payload must have the size of the layout.
    pub(crate) fn put(&mut self, slot: usize, header: UnrollHeader, payload: &Pieces) {
        self.unrolls.put(slot, payload);
        self.headers[slot] = header;
        self.filled[slot] = true;
        self.used += 1;
    }

    /// Frees the slots of the unrolls that are not `kept`. Returns the tasks of the removed unrolls.
    pub(crate) fn retain(&mut self, kept: impl Fn(&UnrollHeader) -> bool) -> Vec<u32> {
        let mut removed = Vec::new();
        for (filled, header) in self.filled.iter_mut().zip(&self.headers) {
            if *filled && !kept(header) {
                *filled = false;
                self.used -= 1;
                removed.push(header.task);
            }
        }
        removed
    }

    /// Moves unrolls from `other` into the free slots of this buffer.
    pub(crate) fn fill_from(&mut self, other: &mut Self) {
        for slot in 0..other.filled.len() {
            if self.is_full() {
                return;
            }
            if !std::mem::take(&mut other.filled[slot]) {
                continue;
            }
            other.used -= 1;
            let free = self.first_free();
            self.unrolls.copy(free, &other.unrolls, slot);
            self.headers[free] = std::mem::take(&mut other.headers[slot]);
            self.filled[free] = true;
            self.used += 1;
        }
    }
}
