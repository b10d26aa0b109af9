//! Motion-capture clips: the reference motions of the tracking task. This crate uses no simulator, no gRPC and no
//! networks.
//!
//! # Layout
//! - [`Catalogue`] is the entry point: the opened clip sources of an experiment. Its [`Entry`]s have names, lengths,
//!   sub-ranges and weights, without the motion; [`Catalogue::load`] reads one [`Clip`].
//! - [`JOINTS`], [`JOINT_RANGES`] and [`ACTUATORS`] describe the CMU humanoid's hinges; [`pose_to_action`] computes the
//!   servo action that aims at a pose.
//! - [`import`] makes clips from CMU's ASF and AMC files, [`check`] finds defects, [`ClipWriter`] writes files that
//!   dm_control reads, and [`merge()`] joins several files. They compute body positions by forward kinematics.
//! - [`edit`] makes more clips of existing ones: mirrored, faster or slower, or legs of one with arms of another.
//! - [`spatial`] has vectors, rotation matrices and quaternions.
//! - [`subset`] lists dm_control's named subsets, [`builtin_names`] the names that can follow `builtin:`, and
//!   [`BUILTIN_TERMS`] the terms of those recordings.
//!
//! A source is `builtin:NAME` (compiled in, or made by the program) or the path of an HDF5 file in the layout of
//! dm_control's mocap files. Such a file has a group per clip. The group has a group `walkers/walker_0` with one
//! float64 dataset `(dim, T)` per quantity. Files are read lazily, by position, in pure Rust. For any content, reading
//! gives a clip or an [`Error`] that names file and dataset; it never panics.

mod body;
mod builtin;
mod catalogue;
pub mod check;
mod clip;
mod cut;
pub mod edit;
mod entry;
mod error;
mod features;
mod file;
mod humanoid;
pub mod import;
mod merge;
mod nearest;
pub mod retarget;
pub mod spatial;
mod subsets;
mod write;

pub use builtin::{BUILTIN_TERMS, builtin_names};
pub use catalogue::{Asset, Catalogue};
pub use clip::{Clip, Features, Motion};
pub use comic_experiment::SUBSETS;
pub use entry::Entry;
pub use error::Error;
pub use humanoid::{ACTUATOR_JOINTS, ACTUATORS, JOINT_RANGES, JOINTS, WalkerModel, pose_to_action};
pub use merge::merge;
pub use subsets::{subset, subsets_with};
pub use write::ClipWriter;
