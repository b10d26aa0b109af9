//! What the learner's service carries, under simulated actors.
//!
//! # Layout
//! - [`host`] is a process with the service in it, or with the floor that the service is compared with. A stand-in takes
//!   batches in the trainer's place.
//! - [`crowd`] is a process with many simulated actors. Each has its own connection and its own [`identity`], sends
//!   unrolls of the real layout and reads parameters. [`statistics`] counts what they do; [`reader`] is the cheapest
//!   possible reader of parameters.
//! - [`process`] starts both and asks them for their numbers; [`usage`] is what a process has used; [`certificates`] are
//!   for figures of TLS.
//! - [`ingest`], [`publish`], [`stalled`] and [`swarm`] are the measurements, [`figure`] the lines that they print.

mod certificates;
mod crowd;
mod figure;
mod host;
mod identity;
mod ingest;
mod paper;
mod process;
mod publish;
mod reader;
mod stalled;
mod statistics;
mod swarm;
mod usage;

pub use crowd::Crowd;
pub use host::Host;
pub use ingest::Ingest;
pub use publish::Publish;
pub use stalled::Stalled;
pub use swarm::Swarm;
