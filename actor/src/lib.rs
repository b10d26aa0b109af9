//! Whatever needs a simulator: acting for a learner, evaluating a policy.
//!
//! # Layout
//! - [`worker`] is the hot path: one thread, its environments, one batched forward pass a step, unrolls out.
//! - [`acting`] is what a forward pass reads and writes; [`policy`] is the one through libtorch.
//! - [`mailbox`] hands the newest parameters to the workers, who look at unroll boundaries only.
//! - [`session`] is the connection to the learner: it joins, fetches assets, watches parameters, sends unrolls until
//!   each is acknowledged, and comes back by itself after every loss.
//! - [`dump`] keeps episodes whose simulation diverged, and plays them again.
//! - [`pulse`] is the process's sign of life, for a container's health check.
//! - [`run`] puts these together into an actor process.
//! - [`evaluate`] measures a policy over the starts of clips; [`checkpoint`] reads what the learner wrote.
//! - [`render`] films a policy at work, or shows it in a window.
//! - [`clips`] is `comic-actor clips`: motion capture in files, and off the network.
//!
//! Nothing here knows a loss, and nothing here is unbounded: finished unrolls wait in a bounded channel, unrolls that
//! are not acknowledged in a bounded window, and behind a full window the environments stand still.

pub mod acting;
pub mod checkpoint;
pub mod clips;
pub mod dump;
mod error;
pub mod evaluate;
pub mod mailbox;
pub mod policy;
pub mod pulse;
pub mod render;
pub mod round;
pub mod run;
pub mod seeds;
pub mod session;
pub mod worker;

pub use error::Error;
