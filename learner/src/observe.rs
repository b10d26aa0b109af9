//! Metrics and evaluations of a run for people, and metrics for Prometheus.

mod catalogue;
pub mod evaluation;
mod evaluation_writer;
mod heat_map;
pub mod metrics;
pub mod probes;
pub mod telemetry;
mod tensorboard;

use std::fs::{File, OpenOptions};
use std::path::Path;

use crate::error::{Error, Result};

/// Opens a file of lines, of which it keeps those that it has.
///
/// # Errors
/// When the file cannot be opened.
fn append(path: &Path) -> Result<File> {
    let file = OpenOptions::new().create(true).append(true).open(path);
    file.map_err(Error::file("write", path))
}
