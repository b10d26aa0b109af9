//! The learner: one process that serves thousands of actors and learns from what they send.
//!
//! # Layout
//! - [`run`] puts the parts of a learner epoch together, and ends them in order.
//! - [`service`] is gRPC on tokio. [`publish`] encodes parameters for the actors. [`security`] is who may use the service.
//! - [`train`] is the OS thread that owns the device: batches in, gradient steps, parameters out. [`device`] is where it
//!   computes: CPU, CUDA or XLA.
//! - [`algorithm`] is what the trainer needs of a learning algorithm. [`vmpo`] is V-MPO, and [`svg0`] SVG(0): experience, losses
//!   and gradient step. [`algorithms`] makes the one that the experiment names. [`adam`] is their optimiser, and [`tensors`] reads and writes its state.
//! - [`world`] is the learners that train one run together, and [`meeting`] how they find each other.
//! - [`checkpoint`] is the run's checkpoint directory. No other module touches it.
//! - [`observe`] is what people and Prometheus see of a run: metrics, evaluations and probes.
//! - `memory_limit` is how much memory the process may use. [`threads`] says how libtorch's threads share the machine.
//! - [`commands`] are the commands besides serving and training. [`options`] is the whole command line, and [`document`] its
//!   arguments for the experiment.
//! - [`error`] is the one error type; `exit_code` decides the exit code by it. `log_limiter` keeps faulty peers from flooding the log.
//!
//! The learner does not link MuJoCo: actors do everything that needs a simulator.

pub mod adam;
pub mod algorithm;
pub mod algorithms;
pub mod checkpoint;
pub mod commands;
pub mod device;
pub mod document;
pub mod error;
mod exit_code;
mod log_limiter;
pub mod meeting;
mod memory_limit;
pub mod observe;
pub mod options;
mod places;
pub mod publish;
mod quota;
pub mod run;
pub mod security;
pub mod service;
pub mod svg0;
pub mod tensors;
pub mod threads;
pub mod train;
pub mod vmpo;
pub mod world;

pub use exit_code::STOPPED;
