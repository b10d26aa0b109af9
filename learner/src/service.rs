//! The learner as actors see it: gRPC over tokio.
//!
//! # Layout
//! - `assembly` makes the parts of a [`Service`] from its [`Setup`], and a [`TrainerHandle`] of those that the trainer needs.
//!   [`serve()`] runs the server until its end, `shutdown` is the state of that end, [`http2`] the protocol's settings, and
//!   [`process`] the threads and file descriptors.
//! - Every connection passes `connections`, and every call `authorisation`: they alone check TLS, tokens and limits. `peer` is
//!   what a call knows of its connection.
//! - `calls` is the service that tonic decodes. `join` accepts actors, `assets` sends files, `offer` is the checkpoint that
//!   evaluators fetch, `evaluations` keeps reports for the trainer, and `status` shows the learner's state.
//! - `framing` is the two calls that carry bytes past tonic's codec; `intake` validates unrolls and puts them into batches,
//!   `room` bounds the messages that were read, and [`quarantine`] keeps invalid unrolls on disk.
//! - [`placement`] sends actors to the rank that they belong to, if several learners train one run.
//! - `roster` knows which actors are present, `assignments` which environments they simulate in lockstep.
//! - [`memory`] computes how much memory all buffers can take.
//!
//! Every stream is pulled: the learner reads an actor's next unroll when the one before it has its place in a batch. HTTP/2's
//! flow control thus carries the back pressure of the batches to the actors, and there is no queue in between.

mod assembly;
mod assets;
mod assignments;
mod authorisation;
mod calls;
mod connections;
pub mod evaluations;
mod framing;
pub mod http2;
mod intake;
mod join;
pub mod memory;
pub mod offer;
mod peer;
pub mod placement;
pub mod process;
pub mod quarantine;
mod room;
mod roster;
mod serve;
mod shutdown;
mod status;

pub use assembly::{Service, Setup, TrainerHandle};
pub use serve::serve;
