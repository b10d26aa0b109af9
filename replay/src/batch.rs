//! A batch in the hands of the trainer.

use std::fmt;
use std::sync::Arc;

use comic_proto::v1::UnrollHeader;
use comic_proto::{Field, Invalid, Pieces, UnrollLayout};

use crate::accounting::Reason;
use crate::buffer::Buffer;

/// Takes the memory of a batch back, and accounts for its unrolls.
pub(crate) trait TakeBack: Send + Sync {
    /// The unrolls in `buffer` were dropped for this reason; without a reason they were trained on.
    fn take_back(&self, buffer: Buffer, dropped: Option<Reason>);
}

/// A full batch in the hands of the trainer.
///
/// It is given back with [`Batcher::trained`](crate::Batcher::trained) or
/// [`Batcher::discard`](crate::Batcher::discard). One that is merely dropped counts as lost at
/// restart: a trainer that lets go of batches is a learner going down.
pub struct Batch {
    /// Where each field of an unroll lies.
    pub layout: Arc<UnrollLayout>,
    /// B.
    pub unrolls: usize,
    buffer: Option<Box<Buffer>>,
    owner: Option<Box<dyn TakeBack>>,
}

impl Batch {
    pub(crate) fn new(layout: Arc<UnrollLayout>, buffer: Buffer, owner: Box<dyn TakeBack>) -> Self {
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
