//! The fixed configuration of a batcher.

/// The configuration of a batcher. It does not change while the batcher exists.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// B, the number of unrolls per batch, at least 1.
    pub unrolls: usize,
    /// Greatest age of an unroll in published versions, when it arrives and when the trainer gets its batch.
    pub max_staleness: u64,
    /// Number of batches that may be assembled while one is trained on. With 0 no unroll is accepted in the meantime,
    /// so unrolls are as new as possible. With 1 the next batch can be ready when the trainer needs it.
    pub ahead: usize,
    /// The order of the unrolls in a batch.
    pub order: BatchOrder,
}

impl Config {
    /// Number of batches of memory into which unrolls are copied for a trainer that takes what is there.
    pub(crate) fn spare(&self) -> usize {
        usize::from(self.order == BatchOrder::Arrival)
    }
}

/// The order of the unrolls in a batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BatchOrder {
    /// In the order of arrival: an unroll gets the next free slot.
    Arrival,
    /// In the order of the environments: an unroll gets the slot with the number of its environment. A batch has one
    /// unroll of each of B environments, so it does not depend on the order of arrival.
    Environment,
}
