//! Metrics and evaluations of a run for people, and metrics for Prometheus.

mod catalogue;
pub mod evaluation;
mod evaluation_history;
mod evaluation_writer;
mod films;
pub mod heartbeat;
mod heat_map;
mod lines;
pub mod metrics_file;
pub(crate) mod page;
pub mod probes;
pub mod prometheus;
mod tensorboard;
mod thinned;
mod whole;
pub mod window;
