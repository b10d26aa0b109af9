//! Bytes as the network delivered them.

use std::collections::VecDeque;
use std::ops::Range;

use bytes::{Buf, Bytes};
use thiserror::Error;

use crate::v1::UnrollHeader;

/// Two neighbours below this are joined, or a peer that sends single bytes would have us keep a piece for each.
const SMALL: usize = 4096;

/// Bytes in the pieces in which they came: the large ones are never copied to join them.
#[derive(Clone, Debug, Default)]
pub struct Pieces {
    /// None is empty.
    pieces: VecDeque<Bytes>,
    length: usize,
}

impl Pieces {
    /// How many bytes there are.
    pub fn len(&self) -> usize {
        self.length
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.length == 0
    }

    /// More bytes, after all others.
    pub fn push(&mut self, mut piece: Bytes) {
        self.length += piece.len();
        // Joined only with one that is no longer, a byte is copied as often as a length can double.
        while let Some(last) = self.pieces.pop_back_if(|last| last.len() < SMALL && last.len() <= piece.len()) {
            piece = [last, piece].concat().into();
        }
        if !piece.is_empty() {
            self.pieces.push_back(piece);
        }
    }

    /// Takes so many bytes off the front; `None`, and all stays, when there are fewer.
    pub fn split_to(&mut self, length: usize) -> Option<Self> {
        let rest = self.length.checked_sub(length)?;
        let mut front = Self { pieces: VecDeque::new(), length };
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
        self.pieces.iter().filter_map(move |piece| {
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
        let mut rest = into;
        for bytes in self.range(start..start + rest.len()) {
            let (place, after) = rest.split_at_mut(bytes.len());
            place.copy_from_slice(bytes);
            rest = after;
        }
        assert!(rest.is_empty(), "{} bytes from {start} on, of {}", rest.len(), self.length);
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

impl From<Bytes> for Pieces {
    fn from(bytes: Bytes) -> Self {
        let mut pieces = Self::default();
        pieces.push(bytes);
        pieces
    }
}

impl Buf for Pieces {
    fn remaining(&self) -> usize {
        self.length
    }

    fn chunk(&self) -> &[u8] {
        self.pieces.front().map_or(&[], |piece| piece)
    }

    fn advance(&mut self, count: usize) {
        let passed = self.split_to(count);
        assert!(passed.is_some(), "{count} bytes of {}", self.length);
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
