//! Training: one OS thread that owns the device. Batches in, gradient steps, parameters out.

mod minibatches;
mod skipped_steps;
mod state;
pub mod statistics;
pub mod trainer;
pub mod warm_start;
pub mod writer;
