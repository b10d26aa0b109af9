//! A batch of unrolls, one contiguous array per field.

use std::fmt;
use std::ops::Range;
use std::sync::Arc;

use comic_proto::v1::UnrollHeader;
use comic_proto::{Field, Invalid, UnrollLayout};

use crate::Batcher;
use crate::ledger::Reason;

/// The arrays of a batch: `[B, rows, width]` for each field. Made once and used again and again.
#[derive(Debug)]
pub(crate) struct Buffer {
    /// In the order of [`Field::ALL`]; the clips and the images stay empty here.
    floats: [Vec<f32>; Field::ALL.len()],
    clips: Vec<u32>,
    images: Vec<u8>,
    pub(crate) headers: Vec<UnrollHeader>,
}

impl Buffer {
    pub(crate) fn new(layout: &UnrollLayout, unrolls: usize) -> Self {
        let elements = |field: Field| layout.elements(field) * unrolls;
        Self {
            floats: Field::ALL.map(|field| match field {
                Field::Clip | Field::Image => Vec::new(),
                _ => vec![0.0; elements(field)],
            }),
            clips: vec![0; elements(Field::Clip)],
            images: vec![0; elements(Field::Image)],
            headers: Vec::with_capacity(unrolls),
        }
    }

    /// Slots in use.
    pub(crate) fn len(&self) -> usize {
        self.headers.len()
    }

    /// Copies an unroll into the next slot: each field once, from where the network put it to where it is trained on.
    /// The payload's size is the layout's, and a slot is free.
    pub(crate) fn push(&mut self, layout: &UnrollLayout, header: UnrollHeader, payload: &[u8]) {
        let slot = self.headers.len();
        for field in Field::ALL {
            let place = place(layout, field, slot);
            let bytes: &mut [u8] = match field {
                Field::Clip => bytemuck::cast_slice_mut(&mut self.clips[place]),
                Field::Image => &mut self.images[place],
                _ => bytemuck::cast_slice_mut(&mut self.floats[field as usize][place]),
            };
            bytes.copy_from_slice(&payload[layout.range(field)]);
        }
        self.headers.push(header);
    }

    /// Lets go of the unrolls that are not `kept`; the last ones take their slots. Gives how many went.
    pub(crate) fn retain(&mut self, layout: &UnrollLayout, kept: impl Fn(&UnrollHeader) -> bool) -> usize {
        let before = self.len();
        // From the last one on, so that none is moved that goes itself.
        for slot in (0..before).rev().filter(|slot| !kept(&self.headers[*slot])).collect::<Vec<_>>() {
            self.headers.swap_remove(slot);
            let last = self.headers.len();
            if slot == last {
                continue;
            }
            for field in Field::ALL {
                let (from, to) = (place(layout, field, last), place(layout, field, slot).start);
                match field {
                    Field::Clip => self.clips.copy_within(from, to),
                    Field::Image => self.images.copy_within(from, to),
                    _ => self.floats[field as usize].copy_within(from, to),
                }
            }
        }
        before - self.len()
    }

    /// Moves the last unrolls of `other` here, until there are so many.
    pub(crate) fn fill_from(&mut self, layout: &UnrollLayout, other: &mut Buffer, unrolls: usize) {
        while self.len() < unrolls
            && let Some(header) = other.headers.pop()
        {
            for field in Field::ALL {
                let (from, to) = (place(layout, field, other.len()), place(layout, field, self.len()));
                match field {
                    Field::Clip => self.clips[to].copy_from_slice(&other.clips[from]),
                    Field::Image => self.images[to].copy_from_slice(&other.images[from]),
                    _ => self.floats[field as usize][to].copy_from_slice(&other.floats[field as usize][from]),
                }
            }
            self.headers.push(header);
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
        unrolls: impl IntoIterator<Item = (UnrollHeader, impl AsRef<[u8]>), IntoIter: ExactSizeIterator>,
    ) -> Result<Self, Invalid> {
        let unrolls = unrolls.into_iter();
        let mut buffer = Buffer::new(&layout, unrolls.len());
        for (header, payload) in unrolls {
            let payload = payload.as_ref();
            if payload.len() != layout.size() {
                return Err(Invalid::Length { found: payload.len(), expected: layout.size() });
            }
            buffer.push(&layout, header, payload);
        }
        Ok(Self { layout, unrolls: buffer.len(), buffer: Some(Box::new(buffer)), owner: None })
    }

    /// A field of `f32`, `[B, rows, width]`; empty for [`Field::Clip`] and [`Field::Image`], which are
    /// [`clip`](Self::clip) and [`image`](Self::image).
    pub fn f32(&self, field: Field) -> &[f32] {
        self.buffer.as_ref().map_or(&[], |buffer| &buffer.floats[field as usize])
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

    /// Ends its life in the books: trained on, or dropped for a reason.
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
