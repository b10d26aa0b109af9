//! The learner: one process that serves thousands of actors and learns from what they send.
//!
//! # Layout
//! - [`run`] puts the parts together and takes them apart again.
//! - [`service`] is gRPC on tokio; [`publish`] is parameters on their way down.
//! - [`trainer`] is the OS thread that owns the device: batches in, gradient steps, parameters out; `minibatches` is what
//!   it makes of a batch. [`warm_start`] is what it does before.
//! - [`device`] is where it computes: CPU, CUDA, XLA.
//! - [`algorithm`] is what the loop needs of a learning algorithm; [`vmpo`] is V-MPO: losses, and the gradient step. [`adam`] is its optimiser.
//! - `skipped_steps` counts gradient steps that were skipped, and leads back to the last good state.
//! - `state` turns the trainer into a snapshot and back. [`checkpoint`] is the run's checkpoint directory, [`writer`] the thread that fills it.
//! - [`export`] makes a checkpoint's policy a file that others read.
//! - [`metrics`] is what a person sees of learning, [`telemetry`] what Prometheus sees of the service, by way of [`probes`].
//! - [`quarantine`] keeps unrolls that were refused, for whoever looks into it.
//! - [`security`] is who may talk to it; [`certs`] makes certificates for trying that out.
//! - [`status`] and [`health`] are commands that ask another learner how it is.
//! - [`sizes`] counts parameters, [`memory`] the bytes that buffers can take.
//!
//! There is no MuJoCo here: whatever needs a simulator is done by actors.

pub mod adam;
pub mod algorithm;
pub mod checkpoint;
pub mod commands;
pub mod device;
pub mod document;
pub mod error;
mod log_limiter;
pub mod observe;
pub mod options;
pub mod publish;
pub mod run;
pub mod security;
pub mod service;
pub mod tensors;
pub mod train;
pub mod vmpo;
