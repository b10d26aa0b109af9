//! A batch at the trainer.

use std::sync::Arc;
use std::{fmt, mem};

use comic_proto::v1::UnrollHeader;
use comic_proto::{Field, Invalid, Pieces, UnrollLayout};

use crate::accounting::Reason;
use crate::buffer::Buffer;
use crate::unrolls::Unrolls;

/// Takes the memory of a batch back, and accounts for its unrolls.
pub(crate) trait TakeBack: Send + Sync {
    /// The unrolls in `buffer` were dropped for this reason; without a reason they were trained on.
    fn take_back(&self, buffer: Buffer, dropped: Option<Reason>);
}

/// A batch at the trainer. It is full, unless the trainer asked for the unrolls that wait
/// ([`Batcher::next_available_within`](crate::Batcher::next_available_within)).
///
/// The trainer returns it with [`Batcher::trained`](crate::Batcher::trained) or
/// [`Batcher::discard`](crate::Batcher::discard). The unrolls of a batch that is dropped
/// count as lost at restart, because a trainer drops batches only when the learner stops.
pub struct Batch {
    /// The layout of its unrolls.
    pub layout: Arc<UnrollLayout>,
    /// B, the number of unrolls.
    pub unrolls: usize,
    buffer: Box<Buffer>,
    owner: Option<Box<dyn TakeBack>>,
}

impl Batch {
    /// The unrolls of `buffer` must be in its first slots.
    pub(crate) fn new(layout: Arc<UnrollLayout>, mut buffer: Buffer, owner: Box<dyn TakeBack>) -> Self {
        buffer.unrolls.set_len(buffer.len());
        Self { layout, unrolls: buffer.len(), buffer: Box::new(buffer), owner: Some(owner) }
    }

    /// A batch of these unrolls that belongs to no batcher, for example from a recording.
    ///
    /// # Errors
    /// [`Invalid::Length`] if the length of a payload is not that of the layout.
    pub fn assemble(
        layout: Arc<UnrollLayout>,
        unrolls: impl IntoIterator<Item = (UnrollHeader, impl Into<Pieces>), IntoIter: ExactSizeIterator>,
    ) -> Result<Self, Invalid> {
        let unrolls = unrolls.into_iter();
        let mut buffer = Buffer::new(Arc::clone(&layout), unrolls.len());
        for (slot, (header, payload)) in unrolls.enumerate() {
            let payload = payload.into();
            if payload.len() != layout.size() {
                return Err(Invalid::Length { found: payload.len(), expected: layout.size() });
            }
            buffer.put(slot, header, &payload);
        }
        Ok(Self { layout, unrolls: buffer.len(), buffer: Box::new(buffer), owner: None })
    }

    /// The arrays of its unrolls.
    pub fn as_unrolls(&self) -> &Unrolls {
        &self.buffer.unrolls
    }

    /// A field of `f32`, `[B, rows, width]`. It is empty for [`Field::Clip`] and [`Field::Image`]; see
    /// [`clip`](Self::clip) and [`image`](Self::image).
    pub fn f32(&self, field: Field) -> &[f32] {
        self.buffer.unrolls.f32(field)
    }

    /// The indices of the clips, `[B, T+1]`.
    pub fn clip(&self) -> &[u32] {
        self.buffer.unrolls.clip()
    }

    /// The camera images, `[B, T+1, I]`; empty if the humanoid has no camera.
    pub fn image(&self) -> &[u8] {
        self.buffer.unrolls.image()
    }

    /// The headers, `[B]`, without the layout hash, which is equal in all of them.
    pub fn headers(&self) -> &[UnrollHeader] {
        &self.buffer.headers[..self.buffer.len()]
    }

    /// The task of each unroll, `[B]`: its index among the tasks of the experiment.
    pub fn tasks(&self) -> Vec<usize> {
        self.headers().iter().map(|header| header.task as usize).collect()
    }

    /// Accounts for the unrolls as dropped for this reason, or without a reason as trained on. Returns the memory.
    pub(crate) fn finish(mut self, dropped: Option<Reason>) {
        self.give_back(dropped);
    }

    fn give_back(&mut self, dropped: Option<Reason>) {
        if let Some(owner) = self.owner.take() {
            let nothing = Buffer::new(Arc::clone(&self.layout), 0);
            owner.take_back(mem::replace(&mut *self.buffer, nothing), dropped);
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
