//! What TensorBoard reads of what a learner wrote for it.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use anyhow::{Result, ensure};
use serde::Deserialize;
use serde_json::Value;

use crate::repository::root;
use crate::system::python;

/// Curves by their tags: environment steps and values.
pub type Curves = BTreeMap<String, Vec<(u64, f64)>>;

/// What TensorBoard reads below a directory.
#[derive(Debug, Deserialize)]
pub struct Read {
    /// The curves of the directory's own run.
    pub curves: Curves,
    /// Its images: environment steps, width and height, by their tags.
    pub images: BTreeMap<String, Vec<(u64, u32, u32)>>,
    /// Its texts by their tags.
    pub texts: BTreeMap<String, String>,
    /// The table of runs: the fields and their types.
    pub columns: BTreeMap<String, String>,
    /// The tags of the table's metrics.
    pub metrics: Vec<String>,
    /// The table's rows by their runs.
    pub rows: BTreeMap<String, Row>,
}

/// A run in the table of runs.
#[derive(Debug, Deserialize)]
pub struct Row {
    /// The experiment's fields.
    pub fields: BTreeMap<String, Value>,
    /// The newest values of the metrics.
    pub metrics: BTreeMap<String, f64>,
}

/// Reads everything below a directory.
///
/// # Errors
/// When TensorBoard cannot read the directory, or is not there.
pub fn read(directory: &Path) -> Result<Read> {
    let mut reader = Command::new(python()?);
    let output = reader.arg(root().join("tests/python/read_events.py")).arg(directory).output()?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Ok(serde_json::from_slice(&output.stdout)?)
}

/// The curves of a run.
///
/// # Errors
/// See [`read`].
pub fn curves(directory: &Path) -> Result<Curves> {
    Ok(read(directory)?.curves)
}
