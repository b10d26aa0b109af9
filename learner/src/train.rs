//! Training: one OS thread that owns the device. Batches in, gradient steps, parameters out.
//!
//! # Layout
//! - [`trainer`] is the loop; the other modules do one job each and know nothing of it.
//! - [`parts`] is what a trainer is made of, and how training ends.
//! - `state` is what changes and is saved: the algorithm, [`statistics`] of the observations, and the progress.
//! - `rounds` is what several ranks decide together before each batch.
//! - `versions` publishes parameters; `reports` counts and writes metrics; `budget` is the clock.
//! - `skipped_steps` counts gradient steps that were skipped, and decides how to recover.
//! - `resumed_replay` is what a replay holds when a learner epoch begins.
//! - `checkpoints` decides when one is written, [`writer`] is the thread that writes.

mod budget;
mod checkpoints;
pub mod parts;
mod reports;
mod resumed_replay;
mod rounds;
mod skipped_steps;
mod state;
pub mod statistics;
pub mod trainer;
mod versions;
pub mod writer;
