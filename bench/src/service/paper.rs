//! The experiment that is measured: the paper's tracking.

use std::time::Duration;

use anyhow::{Result, anyhow};
use comic_experiment::{Experiment, TaskSpec};
use comic_proto::{UnrollLayout, UnrollShape};

/// The preset whose unrolls the crowd sends.
const PRESET: &str = "tracking-mlp";
/// What has not happened after this time counts as failed.
pub(super) const PATIENCE: Duration = Duration::from_secs(120);

/// The experiment, what its task needs, and the layout of its unrolls.
pub(super) fn experiment() -> Result<(Experiment, TaskSpec, UnrollLayout)> {
    let experiment = comic_experiment::resolve(PRESET, &[])?;
    let spec = TaskSpec::new(&experiment, vec!["clip".into()]).map_err(|name| anyhow!("no observation `{name}`"))?;
    let layout = UnrollLayout::new(UnrollShape::new(&spec, &experiment));
    Ok((experiment, spec, layout))
}

/// Parses a positive number: of seconds, or of something for each second.
pub(super) fn positive(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(number) if (1e-3..=1e6).contains(&number) => Ok(number),
        _ => Err("must be a number from 0.001 to 1000000".into()),
    }
}
