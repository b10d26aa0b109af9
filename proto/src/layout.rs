//! Where each field of an unroll lies in the payload.

use std::fmt::Write as _;
use std::ops::Range;

use sha2::{Digest, Sha256};

use crate::field::{ELEMENT, Field, UnrollShape};
use crate::per_field::PerField;

/// Room in a message for everything of fixed size around payload and episode statistics.
const HEADER_SLACK: usize = 4096;
/// Room for one episode's statistics without its returns: a few varints and tags.
const EPISODE_SLACK: usize = 64;

/// Where every field of an unroll lies in the payload, and the hash by which both sides know they agree.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnrollLayout {
    shape: UnrollShape,
    ranges: PerField<(usize, usize)>,
    hash: [u8; 32],
}

impl UnrollLayout {
    /// The layout of unrolls of this shape.
    pub fn new(shape: UnrollShape) -> Self {
        let mut ranges = PerField::default();
        let mut description = format!("comic unroll layout 3, little-endian, T={}\n", shape.length);
        let mut start = 0usize;
        for (field, range) in ranges.iter_mut() {
            let (rows, width) = (field.rows(shape.length), field.width(&shape));
            let end = start.saturating_add(rows.saturating_mul(width).saturating_mul(field.element_bytes()));
            *range = (start, end);
            start = end;
            // Writing to a String cannot fail.
            let _ = writeln!(description, "{field} {rows} {width} {}", field.element());
        }
        Self { shape, ranges, hash: Sha256::digest(description).into() }
    }

    /// The shape it was made from.
    pub fn shape(&self) -> &UnrollShape {
        &self.shape
    }

    /// Bytes of a payload.
    pub fn size(&self) -> usize {
        self.range(Field::Image).end
    }

    /// SHA-256 over a canonical description: format version, T, and each field's name, rows, width and type.
    pub fn hash(&self) -> [u8; 32] {
        self.hash
    }

    /// The bytes of a payload in which this field lies.
    pub fn range(&self, field: Field) -> Range<usize> {
        let (start, end) = self.ranges[field];
        start..end
    }

    /// Elements a row.
    pub fn width(&self, field: Field) -> usize {
        field.width(&self.shape)
    }

    /// Rows: T, T + 1 or 1.
    pub fn rows(&self, field: Field) -> usize {
        field.rows(self.shape.length)
    }

    /// Elements of the whole field, rows × width.
    pub fn elements(&self, field: Field) -> usize {
        self.range(field).len() / field.element_bytes()
    }

    /// The most episodes that can end in one unroll: each has its last observation in a row of its own.
    pub fn max_episodes(&self) -> usize {
        self.shape.length.saturating_add(1)
    }

    /// The largest `UnrollMessage` that can be valid, in bytes: what a server sets as its decoding limit.
    pub fn message_limit(&self) -> usize {
        let episode = self.shape.reward_terms.saturating_mul(ELEMENT).saturating_add(EPISODE_SLACK);
        self.size().saturating_add(self.max_episodes().saturating_mul(episode)).saturating_add(HEADER_SLACK)
    }
}
