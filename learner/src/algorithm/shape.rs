//! The sizes of a minibatch.

use comic_proto::UnrollShape;

/// Sizes of a minibatch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MinibatchShape {
    /// B, unrolls.
    pub unrolls: usize,
    /// Number of tasks that an unroll may belong to.
    pub tasks: usize,
    /// The sizes of each unroll.
    pub unroll: UnrollShape,
}
