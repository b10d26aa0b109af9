//! An unroll that an actor writes.

use bytes::Bytes;

use crate::field::Field;
use crate::layout::UnrollLayout;
use crate::validate::Invalid;

/// An unroll that an actor writes row by row and sends as one payload.
///
/// Its memory is a `Vec<u32>`, so every row is aligned for every layout.
#[derive(Clone, Debug)]
pub struct UnrollBuffer {
    layout: UnrollLayout,
    words: Vec<u32>,
}

impl UnrollBuffer {
    /// A new unroll. All numbers are 0, except that standard deviations are 1 and all components have the same weight.
    /// So a row without a transition is valid.
    pub fn new(layout: &UnrollLayout) -> Self {
        let mut buffer = Self { layout: layout.clone(), words: vec![0; layout.size() / size_of::<u32>()] };
        buffer.clear();
        buffer
    }

    /// Resets the buffer to the state of a new one, and keeps its memory.
    pub fn clear(&mut self) {
        self.words.fill(0);
        let std = self.words(Field::Std);
        self.words[std].fill(1.0f32.to_bits());
        let weights = self.words(Field::LogWeights);
        let even = -(self.layout.shape().components as f32).ln();
        self.words[weights].fill(even.to_bits());
    }

    /// The layout of the unroll.
    pub fn layout(&self) -> &UnrollLayout {
        &self.layout
    }

    /// Row `t` of a field of `f32`. [`Field::Clip`] (`u32`) and [`Field::Image`] (bytes) have their own methods.
    ///
    /// # Panics
    /// If the field has no row `t`.
    pub fn row_mut(&mut self, field: Field, t: usize) -> &mut [f32] {
        let range = self.row_words(field, t);
        bytemuck::cast_slice_mut(&mut self.words[range])
    }

    /// Row `t` of a field of `f32`.
    ///
    /// # Panics
    /// If the field has no row `t`.
    pub fn row(&self, field: Field, t: usize) -> &[f32] {
        bytemuck::cast_slice(&self.words[self.row_words(field, t)])
    }

    /// The camera image of row `t`; empty if the humanoid has no camera.
    ///
    /// # Panics
    /// If there is no row `t`.
    pub fn image_mut(&mut self, t: usize) -> &mut [u8] {
        let range = self.row_words(Field::Image, t);
        bytemuck::cast_slice_mut(&mut self.words[range])
    }

    /// Sets the clip of row `t`.
    ///
    /// # Panics
    /// If there is no row `t`.
    pub fn set_clip(&mut self, t: usize, clip: u32) {
        let range = self.row_words(Field::Clip, t);
        self.words[range].fill(clip);
    }

    /// The clip of row `t`.
    ///
    /// # Panics
    /// If there is no row `t`.
    pub fn clip(&self, t: usize) -> u32 {
        self.words[self.row_words(Field::Clip, t).start]
    }

    /// Makes row `t` padding: it gets the observation of the previous row, as the first observation of an episode
    /// without steps.
    ///
    /// # Panics
    /// If there is no row `t`, or no row before it.
    pub fn repeat_observation(&mut self, t: usize) {
        for field in [Field::Proprioception, Field::Task, Field::Clip, Field::Image] {
            let (before, start) = (self.row_words(field, t - 1), self.row_words(field, t).start);
            self.words.copy_within(before, start);
        }
        self.row_mut(Field::First, t).fill(1.0);
    }

    /// A copy of the payload. The buffer can be reused.
    pub fn to_bytes(&self) -> Bytes {
        Bytes::copy_from_slice(bytemuck::cast_slice(&self.words))
    }

    /// The payload, without a copy.
    pub fn into_bytes(self) -> Bytes {
        Bytes::from_owner(Payload(self.words))
    }

    /// The unroll of a payload. The content is not checked; [`validate`](crate::validate()) does that.
    ///
    /// # Errors
    /// [`Invalid::Length`] if the length of the payload is not that of the layout.
    pub fn from_payload(layout: &UnrollLayout, payload: &[u8]) -> Result<Self, Invalid> {
        if payload.len() != layout.size() {
            return Err(Invalid::Length { found: payload.len(), expected: layout.size() });
        }
        let mut buffer = Self { layout: layout.clone(), words: vec![0; layout.size() / size_of::<u32>()] };
        bytemuck::cast_slice_mut(&mut buffer.words).copy_from_slice(payload);
        Ok(buffer)
    }

    /// The words of a field.
    fn words(&self, field: Field) -> std::ops::Range<usize> {
        let bytes = self.layout.range(field);
        bytes.start / size_of::<u32>()..bytes.end / size_of::<u32>()
    }

    /// The words of row `t` of a field.
    fn row_words(&self, field: Field, t: usize) -> std::ops::Range<usize> {
        let rows = self.layout.rows(field);
        assert!(t < rows, "row {t} of {field}, which has {rows} rows");
        let width = self.words(field).len() / rows;
        let start = self.words(field).start + t * width;
        start..start + width
    }
}

/// An owner of the words for [`Bytes`].
struct Payload(Vec<u32>);

impl AsRef<[u8]> for Payload {
    fn as_ref(&self) -> &[u8] {
        bytemuck::cast_slice(&self.0)
    }
}
