//! Measurements: every figure is one line of JSON with a value and, beside it, a floor of the same run.
//!
//! # Layout
//! - [`actor`] measures environments, policies, resets and images against the physics alone.
//! - [`update`] measures the gradient step against its matrix products.
//! - [`replay`] measures the replay's table against bare copies.
//! - [`service`] measures the learner's service under thousands of simulated actors.
//! - [`simulate`] predicts sizes that cannot be measured here.
//! - `median` is the one statistic that all of them print, and `figure` the line of most; `busy` are neighbours that compute;
//!   `transfer` is the experiment of off-policy learning that is measured.
//!
//! There are two programs, since the shipped ones use different allocators: `comic-bench-learner` uses mimalloc, as
//! `comic-learner` does, and `comic-bench-actor` uses the system's. `cargo xtask bench` builds and starts them.

use std::io::IsTerminal as _;

use tracing_subscriber::EnvFilter;

pub mod actor;
mod busy;
mod figure;
mod median;
pub mod replay;
pub mod service;
pub mod simulate;
mod transfer;
pub mod update;

/// Logs to standard error what `RUST_LOG` chooses. The default is warnings: thousands of actors join in a measurement.
pub fn start_logging() {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("warn"));
    let log = tracing_subscriber::fmt().with_writer(std::io::stderr).with_env_filter(filter);
    log.with_ansi(std::io::stderr().is_terminal()).init();
}
