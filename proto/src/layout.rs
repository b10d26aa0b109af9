//! The position of each field of an unroll in the payload. The order is that of [`Field::ALL`].

use std::fmt::Write as _;
use std::ops::Range;

use sha2::{Digest, Sha256};

use crate::field::Field;
use crate::per_field::PerField;
use crate::shape::{ELEMENT, UnrollShape};

/// Bytes in a message for everything except payload and episode statistics.
const HEADER_SLACK: usize = 4096;
/// Bytes for the statistics of one episode without its returns: a few varints and tags.
const EPISODE_SLACK: usize = 64;

/// The position of every field of an unroll in the payload, and a hash by which actor and learner check that their
/// layouts are equal.
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
        let mut description = format!("comic unroll layout 4, little-endian, T={}\n", shape.length);
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

    /// The shape of the unrolls.
    pub fn shape(&self) -> &UnrollShape {
        &self.shape
    }

    /// Size of a payload, bytes.
    pub fn size(&self) -> usize {
        self.range(Field::Image).end
    }

    /// SHA-256 over a canonical description: format version, T, and each field's name, rows, width and type.
    pub fn hash(&self) -> [u8; 32] {
        self.hash
    }

    /// The range of this field in a payload, bytes.
    pub fn range(&self, field: Field) -> Range<usize> {
        let (start, end) = self.ranges[field];
        start..end
    }

    /// Number of elements per row.
    pub fn width(&self, field: Field) -> usize {
        field.width(&self.shape)
    }

    /// Number of rows: T, T + 1 or 1.
    pub fn rows(&self, field: Field) -> usize {
        field.rows(self.shape.length)
    }

    /// Number of elements of the field, rows × width.
    pub fn elements(&self, field: Field) -> usize {
        self.range(field).len() / field.element_bytes()
    }

    /// Greatest number of episodes that can end in one unroll. The last observation of each has its own row.
    pub fn max_episodes(&self) -> usize {
        self.shape.length.saturating_add(1)
    }

    /// Size of the largest valid `UnrollMessage`, bytes. A server uses it as its decoding limit.
    pub fn message_limit(&self) -> usize {
        let episode = self.shape.reward_terms.saturating_mul(ELEMENT).saturating_add(EPISODE_SLACK);
        self.size().saturating_add(self.max_episodes().saturating_mul(episode)).saturating_add(HEADER_SLACK)
    }
}
