//! Presets and overrides.

use comic_experiment::{Experiment, TaskName};
use pyo3::prelude::*;

use crate::refuse;

/// The resolved experiment as TOML. `document` is a preset or a file, an override is `field=value`, and `clips` replaces
/// the experiment's clips unless it is empty.
#[pyfunction]
pub(crate) fn resolve(document: &str, overrides: Vec<String>, clips: Vec<String>) -> PyResult<String> {
    let experiment = comic_experiment::resolve(document, &overrides).map_err(refuse)?.with_clips(&clips);
    experiment.to_toml().map_err(refuse)
}

/// The whole name of the field that a keyword means.
#[pyfunction]
pub(crate) fn find_field(name: &str) -> PyResult<String> {
    comic_experiment::find_field("a keyword", name).map_err(refuse)
}

/// Names of the presets.
#[pyfunction]
pub(crate) fn presets() -> Vec<&'static str> {
    comic_experiment::presets::ALL.iter().map(|(name, _)| *name).collect()
}

/// Names of the tasks.
#[pyfunction]
pub(crate) fn tasks() -> Vec<&'static str> {
    TaskName::ALL.iter().map(|task| task.name()).collect()
}

/// dm_control's names of the actuators without `walker/`, in control order.
#[pyfunction]
pub(crate) fn actuators() -> Vec<&'static str> {
    comic_clips::ACTUATORS.to_vec()
}

/// Names that can follow `builtin:`.
#[pyfunction]
pub(crate) fn builtin_clips() -> Vec<&'static str> {
    comic_clips::builtin_names()
}

/// Reads what [`resolve`] returned.
pub(crate) fn read(toml: &str) -> PyResult<Experiment> {
    Experiment::from_toml("the experiment", toml).map_err(refuse)
}
