//! Messages in gRPC's frames: one that is encoded in advance, and those that are found in received bytes.

use bytes::{Buf as _, BufMut as _, Bytes, BytesMut};
use prost::Message;
use thiserror::Error;

use crate::pieces::Pieces;

/// Bytes before a message ("gRPC over HTTP2", Length-Prefixed-Message): one that says whether the message is compressed, and
/// four with its length, big-endian.
const PREFIX: usize = 5;

/// A message as gRPC sends it: the byte 0 for "not compressed", the length in four bytes (big-endian), the message. The
/// message must be smaller than 4 GiB.
pub fn frame(message: &impl Message) -> Bytes {
    let length = message.encoded_len();
    let mut frame = BytesMut::with_capacity(PREFIX + length);
    frame.put_u8(0);
    frame.put_u32(length as u32);
    message.encode_raw(&mut frame);
    frame.freeze()
}

/// Finds the messages in bytes that arrive in pieces of any size. The bytes of a message are not joined.
#[derive(Debug)]
pub struct FrameReader {
    arrived: Pieces,
    /// Bytes of the message that is arriving, when its prefix is there.
    length: Option<usize>,
    /// Bytes of the largest message.
    limit: usize,
}

/// Why received bytes hold no more messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum FrameError {
    /// The prefix says that the message is compressed.
    #[error("the message is compressed, but the request names no encoding")]
    Compressed,
    /// The prefix has a length over the limit.
    #[error("a message of {length} bytes, the limit is {limit}")]
    Long {
        /// Bytes of the message.
        length: usize,
        /// Bytes of the largest message.
        limit: usize,
    },
}

impl FrameReader {
    /// A reader of messages of at most `limit` bytes.
    pub fn new(limit: usize) -> Self {
        Self { arrived: Pieces::default(), length: None, limit }
    }

    /// Appends bytes.
    pub fn push(&mut self, bytes: Bytes) {
        self.arrived.push(bytes);
    }

    /// Whether a part of a message is there.
    pub fn has_begun(&self) -> bool {
        !self.arrived.is_empty() || self.length.is_some()
    }

    /// Bytes of the message that is arriving, when its prefix is there.
    pub fn length(&self) -> Option<usize> {
        self.length
    }

    /// Removes the next message, if all of it is there.
    ///
    /// # Errors
    /// [`FrameError`]. The bytes after it have no meaning.
    pub fn next_message(&mut self) -> Result<Option<Pieces>, FrameError> {
        let length = match self.length {
            Some(length) => length,
            None => {
                let Some(mut prefix) = self.arrived.split_to(PREFIX) else { return Ok(None) };
                if prefix.get_u8() != 0 {
                    return Err(FrameError::Compressed);
                }
                let (length, limit) = (prefix.get_u32() as usize, self.limit);
                if length > limit {
                    return Err(FrameError::Long { length, limit });
                }
                *self.length.insert(length)
            }
        };
        let message = self.arrived.split_to(length);
        if message.is_some() {
            self.length = None;
        }
        Ok(message)
    }
}
