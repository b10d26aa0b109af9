//! One experiment is one TOML document; this crate is its types, its defaults and its errors, and nothing else.
//!
//! # Layout
//! - [`Experiment`] is the resolved document. Learner and actors read the very same one: the learner is started with
//!   it, actors receive it when they join.
//! - [`presets`] holds the built-in documents.
//! - [`resolve`] turns a preset or a file plus `--set key=value` overrides into an [`Experiment`],
//!   refusing unknown fields with the nearest known name.
//! - [`find_field`] knows a field by the end of its name, [`Experiment::difference`] the field in which two differ.
//! - [`TaskSpec`] is what networks, wire and learner know of a task: sizes and names.
//!
//! Every default is the paper's: (S) the CoMic supplement, (V) V-MPO, (D) a decision of this project where both are
//! silent. A preset that deviates says so in its own file.

mod check;
mod device;
mod document;
mod fields;
mod lines;
mod network;
pub mod presets;
mod resolve;
pub mod seed;
mod spec;
mod tasks;

pub use device::*;
pub use document::*;
pub use fields::{Difference, find_field, nearest};
pub use network::*;
pub use resolve::{Error, resolve};
pub use spec::*;
pub use tasks::*;
