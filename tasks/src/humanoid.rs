//! The CMU humanoid: its compiled model, and what can be read from a simulation of it.

mod body;
pub(crate) mod features;
mod model;
mod names;
pub(crate) mod observation;
mod servos;
pub(crate) mod walker;

pub use model::build;
pub(crate) use model::{build_in, build_with};
pub use names::{END_EFFECTORS, PREFIX};
