//! The fixed configuration of a batcher.

/// What does not change while a batcher lives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// B: unrolls a batch, at least 1.
    pub unrolls: usize,
    /// An unroll may be so many published versions old, when it comes and when its batch is handed out.
    pub max_staleness: u64,
    /// Batches that may be assembled while one is trained on. With 0 nothing is taken meanwhile, and what waits is as
    /// fresh as can be; with 1 the next batch is ready when the trainer is.
    pub ahead: usize,
    /// In which order unrolls stand in a batch.
    pub order: BatchOrder,
}

/// Which slot of a batch an unroll takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BatchOrder {
    /// The next one: first come, first served.
    Arrival,
    /// That of its environment's number. A batch has one unroll of each of B environments, and no order of arrival can
    /// be told from it.
    Environment,
}
