//! Motion-capture clips: what the humanoid is asked to track. Knows neither simulator nor wire nor networks.
//!
//! # Layout
//! - [`Catalogue`] is the entry: an experiment's clip sources, opened. Its [`Entry`]s tell names, lengths, sub-ranges
//!   and weights without reading any motion; [`Catalogue::load`] reads one [`Clip`].
//! - [`JOINTS`], [`JOINT_RANGES`], [`ACTUATORS`] are the CMU humanoid's hinges; [`pose_to_action`] turns a pose into
//!   the action whose servos aim at it.
//! - [`import`] makes clips of CMU's ASF and AMC files, [`check`] finds defects, [`ClipWriter`] writes files that
//!   dm_control reads, [`merge()`] makes one of several. They know the body as rigid bodies, by forward kinematics.
//! - [`spatial`] has vectors, rotation matrices and quaternions.
//! - [`subset`] knows dm_control's named subsets, [`builtin_names`] what can follow `builtin:`.
//!
//! A source is `builtin:NAME` (compiled in, or made by the program) or the path of an HDF5 file in the layout of
//! dm_control's mocap files: a group per clip, in it `walkers/walker_0` with one float64 dataset `(dim, T)` per
//! quantity. Files are read lazily, by position, in pure Rust; whatever a file holds, the outcome is a clip or an
//! [`Error`] that names file and dataset, never a panic.

mod body;
mod builtin;
mod catalogue;
pub mod check;
mod clip;
mod entry;
mod error;
mod features;
mod file;
mod humanoid;
pub mod import;
mod merge;
mod nearest;
pub mod spatial;
mod subsets;
mod write;

pub use builtin::builtin_names;
pub use catalogue::{Asset, Catalogue};
pub use clip::{Clip, Features, Motion};
pub use comic_experiment::SUBSETS;
pub use entry::Entry;
pub use error::Error;
pub use humanoid::{ACTUATOR_JOINTS, ACTUATORS, JOINT_RANGES, JOINTS, WalkerModel, pose_to_action};
pub use merge::merge;
pub use subsets::{subset, subsets_with};
pub use write::ClipWriter;
