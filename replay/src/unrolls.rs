//! Arrays of unrolls.

use std::ops::Range;
use std::sync::Arc;

use comic_proto::{Field, PerField, Pieces, UnrollLayout};

use crate::uncached_copy;

/// A page of memory is at least so many bytes.
const PAGE: usize = 4096;

/// N unrolls of one layout: one contiguous array `[N, rows, width]` for each field.
///
/// Its memory is allocated once. A part of the slots may be in use ([`set_len`](Self::set_len)); then the arrays are
/// those of the slots in use.
#[derive(Clone, Debug)]
pub struct Unrolls {
    layout: Arc<UnrollLayout>,
    /// Slots that are allocated.
    capacity: usize,
    /// N, the slots in use.
    len: usize,
    /// Empty for clips and images.
    floats: PerField<Vec<f32>>,
    clips: Vec<u32>,
    images: Vec<u8>,
}

impl Unrolls {
    /// `n` unrolls of zeros.
    pub fn new(layout: Arc<UnrollLayout>, n: usize) -> Self {
        let elements = |field: Field| layout.elements(field) * n;
        Self {
            floats: PerField::from_fn(|field| match field {
                Field::Clip | Field::Image => Vec::new(),
                _ => vec![0.0; elements(field)],
            }),
            clips: vec![0; elements(Field::Clip)],
            images: vec![0; elements(Field::Image)],
            layout,
            capacity: n,
            len: n,
        }
    }

    /// The layout of each unroll.
    pub fn layout(&self) -> &Arc<UnrollLayout> {
        &self.layout
    }

    /// N, the number of unrolls.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is no unroll.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Uses the first `n` slots, or all that are allocated if there are fewer. Nothing is copied or cleared.
    pub fn set_len(&mut self, n: usize) {
        self.len = n.min(self.capacity);
    }

    /// A field of `f32`, `[N, rows, width]`. It is empty for [`Field::Clip`] and [`Field::Image`]; see
    /// [`clip`](Self::clip) and [`image`](Self::image).
    pub fn f32(&self, field: Field) -> &[f32] {
        let values = &self.floats[field];
        &values[..self.used(field).min(values.len())]
    }

    /// As [`f32`](Self::f32), to be written.
    pub fn f32_mut(&mut self, field: Field) -> &mut [f32] {
        let used = self.used(field);
        let values = &mut self.floats[field];
        let used = used.min(values.len());
        &mut values[..used]
    }

    /// The indices of the clips, `[N, T+1]`.
    pub fn clip(&self) -> &[u32] {
        &self.clips[..self.used(Field::Clip)]
    }

    /// As [`clip`](Self::clip), to be written.
    pub fn clip_mut(&mut self) -> &mut [u32] {
        let used = self.used(Field::Clip);
        &mut self.clips[..used]
    }

    /// The camera images, `[N, T+1, I]`; empty if the humanoid has no camera.
    pub fn image(&self) -> &[u8] {
        &self.images[..self.used(Field::Image)]
    }

    /// As [`image`](Self::image), to be written.
    pub fn image_mut(&mut self) -> &mut [u8] {
        let used = self.used(Field::Image);
        &mut self.images[..used]
    }

    /// A field of the unroll in one slot, as bytes: `[rows, width]`.
    ///
    /// # Panics
    /// If the slot is not allocated.
    pub fn bytes(&self, field: Field, slot: usize) -> &[u8] {
        let range = self.range(field, slot);
        match field {
            Field::Clip => bytemuck::cast_slice(&self.clips[range]),
            Field::Image => &self.images[range],
            _ => bytemuck::cast_slice(&self.floats[field][range]),
        }
    }

    /// As [`bytes`](Self::bytes), to be written.
    ///
    /// # Panics
    /// If the slot is not allocated.
    pub fn bytes_mut(&mut self, field: Field, slot: usize) -> &mut [u8] {
        let range = self.range(field, slot);
        match field {
            Field::Clip => bytemuck::cast_slice_mut(&mut self.clips[range]),
            Field::Image => &mut self.images[range],
            _ => bytemuck::cast_slice_mut(&mut self.floats[field][range]),
        }
    }

    /// Copies the unroll in slot `from` of `source` to slot `to`.
    ///
    /// # Panics
    /// If one of the slots is not allocated, or the layouts differ.
    pub fn copy(&mut self, to: usize, source: &Self, from: usize) {
        for field in Field::ALL {
            self.bytes_mut(field, to).copy_from_slice(source.bytes(field, from));
        }
    }

    /// Copies a payload, which must have the size of the layout, to a slot: each field once, from the received pieces
    /// to its place.
    pub(crate) fn put(&mut self, slot: usize, payload: &Pieces) {
        for field in Field::ALL {
            let start = self.layout.range(field).start;
            payload.copy_by(start, self.bytes_mut(field, slot), uncached_copy::copy);
        }
    }

    /// Writes to every page, so that the system commits the memory now and not when it is first used. The unrolls are
    /// undefined then.
    pub(crate) fn commit(&mut self) {
        let floats = self.floats.iter_mut().map(|(_, values)| bytemuck::cast_slice_mut(values));
        for bytes in floats.chain([bytemuck::cast_slice_mut(&mut self.clips), &mut self.images]) {
            // Not 0: the compiler may remove the writing of zeros to zeroed memory.
            bytes.iter_mut().step_by(PAGE).for_each(|byte| *byte = 1);
            bytes.iter_mut().next_back().into_iter().for_each(|byte| *byte = 1);
        }
    }

    /// Elements of the slots in use.
    fn used(&self, field: Field) -> usize {
        self.len * self.layout.elements(field)
    }

    /// The elements of one slot.
    fn range(&self, field: Field, slot: usize) -> Range<usize> {
        let elements = self.layout.elements(field);
        slot * elements..(slot + 1) * elements
    }
}
