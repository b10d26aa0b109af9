//! Everything that needs a simulator: acting for a learner, and evaluating and filming policies.
//!
//! # Layout
//! - [`worker`] is the hot path: one thread, its environments, one batched forward pass a step, full unrolls out.
//! - [`acting_loop`] is the loop that the worker and the evaluation share.
//! - [`forward_pass`] is what a forward pass reads and writes; [`policy`] is the forward pass through libtorch.
//! - [`mailbox`] gives the newest parameters to the workers, which take them at unroll boundaries only.
//! - [`round`] lets a worker wait until the learner has answered for its last unrolls.
//! - [`session`] is the connection to the learner. It joins, fetches assets, receives parameters, sends each unroll until
//!   it is acknowledged, and reconnects after every loss.
//! - [`dump`] writes episodes whose simulation diverged, and reproduces them.
//! - [`liveness`] is the file for a container's health check.
//! - [`run`] is the actor process made of these parts.
//! - [`evaluate`] measures a policy over the starts of clips; [`checkpoint`] reads the learner's checkpoints.
//! - [`latents`] collects latents for a prior, and [`assess`] measures a low level before anything is learned with it.
//! - [`film`] draws and writes films, and [`page`] writes pages for a browser; [`render`] makes one of a policy, or shows it in a
//!   window.
//! - [`clips`] is `comic-actor clips`: motion capture from files and from the network.
//!
//! No loss is computed here. All memory is bounded: full unrolls wait in a bounded channel, unrolls without
//! acknowledgement in a bounded window. When the window is full, the environments wait.

pub mod acting_loop;
pub mod assess;
pub mod checkpoint;
pub mod clips;
pub mod dump;
mod error;
pub mod evaluate;
pub mod film;
pub mod forward_pass;
pub mod latents;
pub mod liveness;
pub mod mailbox;
mod output_file;
pub mod page;
pub mod policy;
pub mod render;
pub mod round;
pub mod run;
pub mod seeds;
pub mod session;
pub mod worker;

pub use error::Error;
