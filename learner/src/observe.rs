//! What people and Prometheus see of a run.

pub mod evaluation;
pub mod metrics;
pub mod probes;
pub mod telemetry;
mod tensorboard;
