//! What TensorBoard reads of what a learner wrote for it.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use anyhow::{Result, ensure};

use crate::repository::root;
use crate::system::python;

/// Curves by their tags: environment steps and values.
///
/// # Errors
/// When TensorBoard cannot read the directory, or is not there.
pub fn curves(directory: &Path) -> Result<BTreeMap<String, Vec<(u64, f64)>>> {
    let mut reader = Command::new(python()?);
    let output = reader.arg(root().join("tests/python/read_events.py")).arg(directory).output()?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Ok(serde_json::from_slice(&output.stdout)?)
}
