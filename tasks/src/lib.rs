//! The humanoid and its tasks: observation, reward, termination. This crate knows neither libtorch nor the wire.
//!
//! # Layout
//! - [`Task`] is what all environments of a process share, and [`Environment`] is one simulation of it. [`build`] makes the
//!   task of an experiment (`build_task.rs`). Acting needs nothing else.
//! - `tracking/` follows clips: [`TrackingTask`] and [`TrackingEnvironment`].
//! - `rules/` has all other tasks. Each is one file of rules: how an episode begins, the reward of a step, when the
//!   humanoid fails, and what an episode achieved. One environment plays the rules of any task. [`comparison`] replays
//!   recorded episodes of dm_control.
//! - `gradient.rs` differentiates the reward with respect to the actions, for every task but ball-catch.
//! - `joint.rs` plays several tasks, one in each episode.
//! - [`humanoid`] makes the compiled model from dm_control's XML, and `arenas/` makes what surrounds the humanoid.
//! - `rendering/` draws: [`film`] and `viewer` for people, [`vision`] for the policy; [`geometry`] has the same as numbers.
//! - [`raw_physics`] steps the physics without a task: the lower limit of an environment's time in benchmarks.
//!
//! Tracking, go-to-target and the corridors are dm_control's: the state of the simulation is equal bit for bit,
//! observations and rewards to 1e-12 (`tests/parity`).

mod achievement;
mod arenas;
mod assets;
mod build_task;
mod environment;
mod error;
mod gradient;
pub mod humanoid;
mod joint;
mod physics;
pub mod raw_physics;
mod rendering;
mod rules;
mod silence;
mod tracking;

pub use achievement::Achievement;
pub use build_task::build;
pub use environment::{ClipStarts, Environment, Episode, MAX_REWARD_TERMS, Outcome, Scenery, Simulated, Step, Task};
pub use error::Error;
pub use physics::Simulation;
pub use rendering::ghost::Ghost;
#[cfg(feature = "viewer")]
pub use rendering::viewer;
pub use rendering::{film, geometry, vision};
pub use rules::comparison;
pub use tracking::{TrackingEnvironment, TrackingTask};
