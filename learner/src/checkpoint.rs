//! The checkpoint directory; no other module touches it.
//!
//! A checkpoint is a directory `checkpoint-NNNNNNNNNN` (the number of updates) with one file per part and a
//! `MANIFEST.json` that holds each part's SHA-256. It is written beside its final name, synced, renamed, and the parent
//! synced, so a crash leaves either the whole checkpoint or none. One more, `initial`, is kept for
//! comparison. `best.json` names the checkpoint with the best evaluation, which is also kept; the link `best` points
//! to it.
//!
//! # Layout
//! - [`Store`] is the directory: writing, finding the newest, repairing. [`Name`] is what a checkpoint is called.
//! - [`Snapshot`] is a checkpoint in memory; [`read`] and [`find`] read one. `progress` is its part `progress.json`.
//! - `saved_replay` is the file of an off-policy algorithm's replay.
//! - `best` compares evaluations. `steps` is what is done to the disk, one step after another; `crash` tests a crash between
//!   any two of them.

mod best;
#[cfg(test)]
mod crash;
mod name;
pub(crate) mod progress;
pub(crate) mod saved_replay;
pub(crate) mod snapshot;
mod steps;
mod store;

pub use best::{Evaluated, Judgement};
pub use name::Name;
pub use snapshot::{Snapshot, find, read};
pub(crate) use steps::replace_file;
pub use store::Store;
pub(crate) use store::incompatible;
