//! The memory of a batch: one contiguous array per field.

use std::ops::Range;

use comic_proto::v1::UnrollHeader;
use comic_proto::{Field, PerField, Pieces, UnrollLayout};

use crate::streaming;

/// The arrays of a batch: `[B, rows, width]` for each field. A buffer is allocated once and then reused.
#[derive(Debug)]
pub(crate) struct Buffer {
    /// Empty for clips and images.
    pub(crate) floats: PerField<Vec<f32>>,
    pub(crate) clips: Vec<u32>,
    pub(crate) images: Vec<u8>,
    /// One header per slot. A free slot has the header of an earlier unroll.
    pub(crate) headers: Vec<UnrollHeader>,
    filled: Vec<bool>,
    /// Number of slots in use.
    unrolls: usize,
}

impl Buffer {
    pub(crate) fn new(layout: &UnrollLayout, unrolls: usize) -> Self {
        let elements = |field: Field| layout.elements(field) * unrolls;
        Self {
            floats: PerField::from_fn(|field| match field {
                Field::Clip | Field::Image => Vec::new(),
                _ => vec![0.0; elements(field)],
            }),
            clips: vec![0; elements(Field::Clip)],
            images: vec![0; elements(Field::Image)],
            headers: vec![UnrollHeader::default(); unrolls],
            filled: vec![false; unrolls],
            unrolls: 0,
        }
    }

    /// Number of slots in use.
    pub(crate) fn len(&self) -> usize {
        self.unrolls
    }

    /// Whether every slot is in use.
    pub(crate) fn is_full(&self) -> bool {
        self.unrolls == self.filled.len()
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
        self.unrolls = 0;
    }

    /// Copies an unroll into a free slot: each field once, from the received pieces to its place in the batch. The
    /// payload must have the size of the layout.
    pub(crate) fn put(&mut self, layout: &UnrollLayout, slot: usize, header: UnrollHeader, payload: &Pieces) {
        for field in Field::ALL {
            let range = slot_range(layout, field, slot);
            let bytes: &mut [u8] = match field {
                Field::Clip => bytemuck::cast_slice_mut(&mut self.clips[range]),
                Field::Image => &mut self.images[range],
                _ => bytemuck::cast_slice_mut(&mut self.floats[field][range]),
            };
            payload.copy_by(layout.range(field).start, bytes, streaming::copy);
        }
        self.headers[slot] = header;
        self.filled[slot] = true;
        self.unrolls += 1;
    }

    /// Frees the slots of the unrolls that are not `kept`. Returns the tasks of the removed unrolls.
    pub(crate) fn retain(&mut self, kept: impl Fn(&UnrollHeader) -> bool) -> Vec<u32> {
        let mut removed = Vec::new();
        for (filled, header) in self.filled.iter_mut().zip(&self.headers) {
            if *filled && !kept(header) {
                *filled = false;
                self.unrolls -= 1;
                removed.push(header.task);
            }
        }
        removed
    }

    /// Moves unrolls from `other` into the free slots of this buffer.
    pub(crate) fn fill_from(&mut self, layout: &UnrollLayout, other: &mut Buffer) {
        for slot in 0..other.filled.len() {
            if self.is_full() {
                return;
            }
            if !std::mem::take(&mut other.filled[slot]) {
                continue;
            }
            other.unrolls -= 1;
            let free = self.first_free();
            for field in Field::ALL {
                let (from, to) = (slot_range(layout, field, slot), slot_range(layout, field, free));
                match field {
                    Field::Clip => self.clips[to].copy_from_slice(&other.clips[from]),
                    Field::Image => self.images[to].copy_from_slice(&other.images[from]),
                    _ => self.floats[field][to].copy_from_slice(&other.floats[field][from]),
                }
            }
            self.headers[free] = std::mem::take(&mut other.headers[slot]);
            self.filled[free] = true;
            self.unrolls += 1;
        }
    }
}

/// The elements of one slot in the array of a field.
fn slot_range(layout: &UnrollLayout, field: Field, slot: usize) -> Range<usize> {
    let elements = layout.elements(field);
    slot * elements..(slot + 1) * elements
}
