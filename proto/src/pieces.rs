//! Bytes as the network delivered them.

use std::collections::VecDeque;
use std::ops::Range;

use bytes::{Buf, Bytes, BytesMut};
use thiserror::Error;

use crate::v1::UnrollHeader;

/// Bytes in the pieces in which they came: the large ones stay where they are, and are never copied to join them.
#[derive(Clone, Debug, Default)]
pub struct Pieces {
    /// None is empty.
    pieces: VecDeque<Bytes>,
    /// After them, what came in small ones.
    tail: BytesMut,
    length: usize,
}

impl Pieces {
    /// A piece of so many bytes is kept where it lies, with the buffer it is a part of. Smaller ones are copied: a peer
    /// that sends single bytes must not have us keep a buffer for each.
    pub const KEPT: usize = 128 * 1024;

    /// How many bytes there are.
    pub fn len(&self) -> usize {
        self.length
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.length == 0
    }

    /// More bytes, after all others.
    pub fn push(&mut self, piece: Bytes) {
        self.length += piece.len();
        if piece.len() < Self::KEPT {
            self.tail.extend_from_slice(&piece);
            return;
        }
        self.seal();
        self.pieces.push_back(piece);
    }

    fn seal(&mut self) {
        if !self.tail.is_empty() {
            self.pieces.push_back(self.tail.split().freeze());
        }
    }

    /// Takes so many bytes off the front; `None`, and all stays, when there are fewer.
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

    /// The bytes of a range, piece by piece; of one that goes beyond the end, those that there are.
    pub fn range(&self, range: Range<usize>) -> impl Iterator<Item = &[u8]> {
        let mut begin = 0;
        let pieces = self.pieces.iter().map(|piece| &piece[..]).chain([&self.tail[..]]);
        pieces.filter_map(move |piece| {
            let place = begin;
            begin += piece.len();
            let within = |end: usize| end.saturating_sub(place).min(piece.len());
            let bytes = &piece[within(range.start)..within(range.end.max(range.start))];
            (!bytes.is_empty()).then_some(bytes)
        })
    }

    /// Copies what begins at `start`.
    ///
    /// # Panics
    /// When there is less than `into` has room for.
    pub fn copy_to(&self, start: usize, into: &mut [u8]) {
        self.copy_by(start, into, |from, into| into.copy_from_slice(from));
    }

    /// The same by another way of copying, which is called with two slices of one length.
    ///
    /// # Panics
    /// When there is less than `into` has room for.
    pub fn copy_by(&self, start: usize, into: &mut [u8], copy: impl Fn(&[u8], &mut [u8])) {
        let mut rest = into;
        for bytes in self.range(start..start + rest.len()) {
            let (place, after) = rest.split_at_mut(bytes.len());
            copy(bytes, place);
            rest = after;
        }
        assert!(rest.is_empty(), "{} bytes are missing from {start} on: there are {}", rest.len(), self.length);
    }

    /// Does something with each word, little end first, of a range of whole words.
    pub(crate) fn for_each_word(&self, range: Range<usize>, mut visit: impl FnMut(u32)) {
        // Of a word that was cut.
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

/// Each stays as it is, however small.
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

/// A [`UnrollMessage`](crate::v1::UnrollMessage) as it is received: its payload stays in the pieces in which it came.
#[derive(Clone, Debug, Default)]
pub struct ReceivedUnroll {
    /// `None` in a message without one.
    pub header: Option<UnrollHeader>,
    /// The bytes of the layout.
    pub payload: Pieces,
}

/// Bytes that are no message of an unroll.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("not a message of this protocol: {0}")]
pub struct Malformed(String);

impl ReceivedUnroll {
    /// What the message says, exactly as its generated type would have it, but for groups, which are refused.
    ///
    /// # Errors
    /// [`Malformed`] when it is no such message.
    pub fn decode(mut message: Pieces) -> Result<Self, Malformed> {
        let mut unroll = Self::default();
        while message.has_remaining() {
            // "Protocol Buffers, Encoding": a field's number and, in three bits, what follows.
            let key = u32::try_from(varint(&mut message)?).map_err(|_| malformed("a field's number"))?;
            match (key >> 3, key & 7) {
                (0, _) => return Err(malformed("a field's number")),
                (1, 2) => {
                    let header = unroll.header.get_or_insert_default();
                    prost::Message::merge(header, part(&mut message)?).map_err(|error| Malformed(error.to_string()))?;
                }
                (2, 2) => unroll.payload = part(&mut message)?,
                (1 | 2, _) => return Err(malformed("a field of another type")),
                (_, 0) => drop(varint(&mut message)?),
                (_, 1) => drop(message.split_to(8).ok_or_else(|| malformed("its end is missing"))?),
                (_, 2) => drop(part(&mut message)?),
                (_, 5) => drop(message.split_to(4).ok_or_else(|| malformed("its end is missing"))?),
                _ => return Err(malformed("a field of no type")),
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

fn part(message: &mut Pieces) -> Result<Pieces, Malformed> {
    let length = varint(message)?;
    message.split_to(length).ok_or_else(|| malformed("its end is missing"))
}
