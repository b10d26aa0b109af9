//! Metrics of a run for people and for Prometheus.

mod catalogue;
pub mod evaluation;
pub mod metrics;
pub mod probes;
pub mod telemetry;
mod tensorboard;
