//! Metrics and evaluations of a run for people, and metrics for Prometheus.

mod catalogue;
pub mod evaluation;
mod evaluation_writer;
mod films;
pub mod heartbeat;
mod heat_map;
pub mod metrics_file;
pub mod probes;
pub mod prometheus;
mod tensorboard;
mod whole;
