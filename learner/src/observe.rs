//! Metrics of a run for people and for Prometheus.

pub mod evaluation;
pub mod metrics;
pub mod probes;
pub mod telemetry;
mod tensorboard;
