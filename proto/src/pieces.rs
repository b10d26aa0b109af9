//! Received bytes in the pieces of the network.

use std::collections::VecDeque;
use std::ops::Range;

use bytes::{Buf, Bytes, BytesMut};
use thiserror::Error;

use crate::v1::UnrollHeader;

/// Bytes in pieces, as they were received. Large pieces stay in their buffers and are never copied to join them.
#[derive(Clone, Debug, Default)]
pub struct Pieces {
    /// No piece is empty.
    pieces: VecDeque<Bytes>,
    /// The small pieces after the last large one, joined.
    tail: BytesMut,
    length: usize,
}

impl Pieces {
    /// A piece of at least this number of bytes keeps its buffer. Smaller pieces are copied, so that a peer that sends
    /// single bytes cannot occupy a buffer for each of them.
    pub const KEPT: usize = 128 * 1024;

    /// Number of bytes.
    pub fn len(&self) -> usize {
        self.length
    }

    /// Whether there are no bytes.
    pub fn is_empty(&self) -> bool {
        self.length == 0
    }

    /// Appends bytes.
    pub fn push(&mut self, piece: Bytes) {
        self.length += piece.len();
        if piece.len() < Self::KEPT {
            self.tail.extend_from_slice(&piece);
            return;
        }
        self.seal();
        self.pieces.push_back(piece);
    }

    /// Makes a piece of the tail.
    fn seal(&mut self) {
        if !self.tail.is_empty() {
            self.pieces.push_back(self.tail.split().freeze());
        }
    }

    /// Removes the first `length` bytes and returns them. If there are fewer, returns `None` and changes nothing.
    pub fn split_to(&mut self, length: usize) -> Option<Self> {
        let rest = self.length.checked_sub(length)?;
        self.seal();
        let mut front = Self { length, ..Self::default() };
        let mut missing = length;
        while missing > 0 {
            let mut piece = self.pieces.pop_front()?;
            if piece.len() > missing {
                self.pieces.push_front(piece.split_off(missing));
            }
            missing -= piece.len();
            front.pieces.push_back(piece);
        }
        self.length = rest;
        Some(front)
    }

    /// The bytes of a range, piece by piece. A range beyond the end is shortened.
    pub fn range(&self, range: Range<usize>) -> impl Iterator<Item = &[u8]> {
        let mut begin = 0;
        let pieces = self.pieces.iter().map(|piece| &piece[..]).chain([&self.tail[..]]);
        pieces.filter_map(move |piece| {
            let start = begin;
            begin += piece.len();
            let within = |end: usize| end.saturating_sub(start).min(piece.len());
            let bytes = &piece[within(range.start)..within(range.end.max(range.start))];
            (!bytes.is_empty()).then_some(bytes)
        })
    }

    /// Copies the bytes from `start` on into `into`, which is filled.
    ///
    /// # Panics
    /// If there are fewer bytes.
    pub fn copy_to(&self, start: usize, into: &mut [u8]) {
        self.copy_by(start, into, |from, into| into.copy_from_slice(from));
    }

    /// Like [`copy_to`](Self::copy_to), with another function that copies. The function gets two slices of equal
    /// length.
    ///
    /// # Panics
    /// If there are fewer bytes.
    pub fn copy_by(&self, start: usize, into: &mut [u8], copy: impl Fn(&[u8], &mut [u8])) {
        let mut rest = into;
        for bytes in self.range(start..start + rest.len()) {
            let (target, after) = rest.split_at_mut(bytes.len());
            copy(bytes, target);
            rest = after;
        }
        assert!(rest.is_empty(), "{} bytes are missing after {start}: there are {}", rest.len(), self.length);
    }

    /// Calls `visit` with each little-endian word of a range of whole words.
    pub(crate) fn for_each_word(&self, range: Range<usize>, mut visit: impl FnMut(u32)) {
        // The bytes of a word that is in two or more pieces.
        let (mut word, mut have) = ([0; 4], 0);
        for mut bytes in self.range(range) {
            if have > 0 {
                let (more, rest) = bytes.split_at(bytes.len().min(word.len() - have));
                word[have..have + more.len()].copy_from_slice(more);
                (have, bytes) = (have + more.len(), rest);
                if have < word.len() {
                    continue;
                }
                visit(u32::from_le_bytes(word));
            }
            let (words, rest) = bytes.as_chunks();
            words.iter().for_each(|word| visit(u32::from_le_bytes(*word)));
            word[..rest.len()].copy_from_slice(rest);
            have = rest.len();
        }
    }
}

/// Pieces of any size keep their buffers.
impl FromIterator<Bytes> for Pieces {
    fn from_iter<I: IntoIterator<Item = Bytes>>(pieces: I) -> Self {
        let pieces: VecDeque<_> = pieces.into_iter().filter(|piece| !piece.is_empty()).collect();
        Self { length: pieces.iter().map(Bytes::len).sum(), pieces, ..Self::default() }
    }
}

impl From<Bytes> for Pieces {
    fn from(bytes: Bytes) -> Self {
        Self::from_iter([bytes])
    }
}

impl Buf for Pieces {
    fn remaining(&self) -> usize {
        self.length
    }

    fn chunk(&self) -> &[u8] {
        self.pieces.front().map_or(&self.tail, |piece| piece)
    }

    fn advance(&mut self, count: usize) {
        assert!(count <= self.length, "{count} bytes of {}", self.length);
        self.length -= count;
        let mut left = count;
        while left > 0 {
            let Some(front) = self.pieces.front_mut() else { return self.tail.advance(left) };
            let passed = left.min(front.len());
            front.advance(passed);
            left -= passed;
            if front.is_empty() {
                self.pieces.pop_front();
            }
        }
    }
}

/// A received [`UnrollMessage`](crate::v1::UnrollMessage). Its payload stays in the received pieces.
#[derive(Clone, Debug, Default)]
pub struct ReceivedUnroll {
    /// The header; `None` if the message has none.
    pub header: Option<UnrollHeader>,
    /// The payload.
    pub payload: Pieces,
}

/// The bytes are not an `UnrollMessage`.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("not a message of this protocol: {0}")]
pub struct Malformed(String);

impl ReceivedUnroll {
    /// Decodes a message with the same result as the generated type, except that groups are refused.
    ///
    /// # Errors
    /// [`Malformed`] if the bytes are not such a message.
    pub fn decode(mut message: Pieces) -> Result<Self, Malformed> {
        let mut unroll = Self::default();
        while message.has_remaining() {
            // See "Encoding" in the documentation of Protocol Buffers: the number of a field, and its wire type in
            // three bits.
            let key = u32::try_from(varint(&mut message)?).map_err(|_| malformed("invalid number of a field"))?;
            match (key >> 3, key & 7) {
                (0, _) => return Err(malformed("invalid number of a field")),
                (1, 2) => {
                    let header = unroll.header.get_or_insert_default();
                    prost::Message::merge(header, part(&mut message)?).map_err(|error| Malformed(error.to_string()))?;
                }
                (2, 2) => unroll.payload = part(&mut message)?,
                (1 | 2, _) => return Err(malformed("invalid type of a field")),
                (_, 0) => drop(varint(&mut message)?),
                (_, 1) => drop(message.split_to(8).ok_or_else(|| malformed("the message is truncated"))?),
                (_, 2) => drop(part(&mut message)?),
                (_, 5) => drop(message.split_to(4).ok_or_else(|| malformed("the message is truncated"))?),
                _ => return Err(malformed("unknown wire type")),
            }
        }
        Ok(unroll)
    }
}

fn malformed(what: &str) -> Malformed {
    Malformed(what.into())
}

fn varint(message: &mut Pieces) -> Result<usize, Malformed> {
    prost::decode_length_delimiter(message).map_err(|error| Malformed(error.to_string()))
}

/// A length and as many bytes.
fn part(message: &mut Pieces) -> Result<Pieces, Malformed> {
    let length = varint(message)?;
    message.split_to(length).ok_or_else(|| malformed("the message is truncated"))
}
