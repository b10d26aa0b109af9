//! A batch of unrolls, one contiguous array per field.

use std::fmt;
use std::ops::Range;
use std::sync::Arc;

use comic_proto::v1::UnrollHeader;
use comic_proto::{Field, Invalid, PerField, Pieces, UnrollLayout};

use crate::ledger::Reason;
use crate::{Batcher, streaming};

/// The arrays of a batch: `[B, rows, width]` for each field. Made once and used again and again.
#[derive(Debug)]
pub(crate) struct Buffer {
    /// Empty for the clips and the images.
    floats: PerField<Vec<f32>>,
    clips: Vec<u32>,
    images: Vec<u8>,
    /// By slot; in a free one stands what was there before.
    headers: Vec<UnrollHeader>,
    filled: Vec<bool>,
    /// Slots in use.
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

    /// Slots in use.
    pub(crate) fn len(&self) -> usize {
        self.unrolls
    }

    /// Whether every slot is in use.
    pub(crate) fn is_full(&self) -> bool {
        self.unrolls == self.filled.len()
    }

    /// The first free slot; beyond the last one when there is none.
    pub(crate) fn first_free(&self) -> usize {
        self.filled.iter().position(|filled| !filled).unwrap_or(self.filled.len())
    }

    /// Whether there is such a slot, and nothing in it.
    pub(crate) fn is_free(&self, slot: usize) -> bool {
        self.filled.get(slot) == Some(&false)
    }

    /// The task of every unroll in it.
    pub(crate) fn tasks(&self) -> impl Iterator<Item = u32> {
        self.filled.iter().zip(&self.headers).filter(|(filled, _)| **filled).map(|(_, header)| header.task)
    }

    /// Frees every slot.
    pub(crate) fn clear(&mut self) {
        self.filled.fill(false);
        self.unrolls = 0;
    }

    /// Copies an unroll into a free slot: each field once, from where the network put it to where it is trained on.
    /// The payload's size is the layout's.
    pub(crate) fn put(&mut self, layout: &UnrollLayout, slot: usize, header: UnrollHeader, payload: &Pieces) {
        for field in Field::ALL {
            let place = place(layout, field, slot);
            let bytes: &mut [u8] = match field {
                Field::Clip => bytemuck::cast_slice_mut(&mut self.clips[place]),
                Field::Image => &mut self.images[place],
                _ => bytemuck::cast_slice_mut(&mut self.floats[field][place]),
            };
            payload.copy_by(layout.range(field).start, bytes, streaming::copy);
        }
        self.headers[slot] = header;
        self.filled[slot] = true;
        self.unrolls += 1;
    }

    /// Frees the slots of the unrolls that are not `kept`, and returns the tasks of those unrolls.
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

    /// Moves unrolls of `other` here, as far as there are free slots.
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
                let (from, to) = (place(layout, field, slot), place(layout, field, free));
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

/// The elements of a slot in a field's array.
fn place(layout: &UnrollLayout, field: Field, slot: usize) -> Range<usize> {
    let elements = layout.elements(field);
    slot * elements..(slot + 1) * elements
}

/// A full batch in the hands of the trainer.
///
/// It is given back with [`Batcher::trained`] or [`Batcher::discard`]. One that is merely dropped counts as lost at
/// restart: a trainer that lets go of batches is a learner going down.
pub struct Batch {
    /// Where each field of an unroll lies.
    pub layout: Arc<UnrollLayout>,
    /// B.
    pub unrolls: usize,
    buffer: Option<Box<Buffer>>,
    owner: Option<Batcher>,
}

impl Batch {
    pub(crate) fn new(layout: Arc<UnrollLayout>, buffer: Buffer, owner: Batcher) -> Self {
        Self { layout, unrolls: buffer.len(), buffer: Some(Box::new(buffer)), owner: Some(owner) }
    }

    /// A batch of these unrolls that belongs to no batcher, for instance from a recording.
    ///
    /// # Errors
    /// [`Invalid::Length`] when a payload is no unroll of this layout.
    pub fn assemble(
        layout: Arc<UnrollLayout>,
        unrolls: impl IntoIterator<Item = (UnrollHeader, impl Into<Pieces>), IntoIter: ExactSizeIterator>,
    ) -> Result<Self, Invalid> {
        let unrolls = unrolls.into_iter();
        let mut buffer = Buffer::new(&layout, unrolls.len());
        for (slot, (header, payload)) in unrolls.enumerate() {
            let payload = payload.into();
            if payload.len() != layout.size() {
                return Err(Invalid::Length { found: payload.len(), expected: layout.size() });
            }
            buffer.put(&layout, slot, header, &payload);
        }
        Ok(Self { layout, unrolls: buffer.len(), buffer: Some(Box::new(buffer)), owner: None })
    }

    /// A field of `f32`, `[B, rows, width]`; empty for [`Field::Clip`] and [`Field::Image`], which are
    /// [`clip`](Self::clip) and [`image`](Self::image).
    pub fn f32(&self, field: Field) -> &[f32] {
        self.buffer.as_ref().map_or(&[], |buffer| &buffer.floats[field])
    }

    /// The clips' indices, `[B, T+1]`.
    pub fn clip(&self) -> &[u32] {
        self.buffer.as_ref().map_or(&[], |buffer| &buffer.clips)
    }

    /// The images, `[B, T+1, I]`; empty when the humanoid is blind.
    pub fn image(&self) -> &[u8] {
        self.buffer.as_ref().map_or(&[], |buffer| &buffer.images)
    }

    /// The headers, `[B]`, without the layout hash, which all of them share.
    pub fn headers(&self) -> &[UnrollHeader] {
        self.buffer.as_ref().map_or(&[], |buffer| &buffer.headers)
    }

    /// The task of each unroll, `[B]`: its index among the tasks of the experiment.
    pub fn tasks(&self) -> Vec<usize> {
        self.headers().iter().map(|header| header.task as usize).collect()
    }

    /// Ends its life in the accounting: trained on, or dropped for a reason.
    pub(crate) fn finish(mut self, end: Option<Reason>) {
        self.give_back(end);
    }

    fn give_back(&mut self, end: Option<Reason>) {
        if let (Some(buffer), Some(owner)) = (self.buffer.take(), self.owner.take()) {
            owner.take_back(*buffer, end);
        }
    }
}

impl Drop for Batch {
    fn drop(&mut self) {
        self.give_back(Some(Reason::LostAtRestart));
    }
}

impl fmt::Debug for Batch {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Batch").field("unrolls", &self.unrolls).finish_non_exhaustive()
    }
}
