//! The native half of the Python package `comic`: environments in batches, experiments and clips. Python's half is in
//! `python/comic`; it gives these functions their names, defaults and documentation.
//!
//! # Layout
//! - [`environments`] steps several environments in threads, without Python's lock.
//! - [`film`] draws pictures of them.
//! - [`experiment`] resolves presets and overrides, and [`clips`] lists, reads, checks and imports clips.
//!
//! libmujoco is the one of the package `mujoco`, which Python imports first.

mod clips;
mod environments;
mod experiment;
mod film;

use pyo3::create_exception;
use pyo3::exceptions::PyValueError;

create_exception!(
    comic,
    Error,
    PyValueError,
    "An experiment, a clip or a start that cannot be used. The message names file, field and remedy."
);

/// A Python exception with the message of `error`.
fn refuse(error: impl std::fmt::Display) -> pyo3::PyErr {
    Error::new_err(error.to_string())
}

/// The entries row by row, whatever their order in memory: numpy also has arrays by columns, and arrays with gaps.
fn row_by_row(array: &numpy::PyReadonlyArray2<'_, f64>) -> Vec<f64> {
    array.as_array().iter().copied().collect()
}

/// What Python imports as `comic._native`.
#[pyo3::pymodule]
mod _native {
    #[pymodule_export]
    use super::Error;
    #[pymodule_export]
    use super::clips::{check_clips, import_clip, list_clips, merge_clips, poses_to_actions, read_clips};
    #[pymodule_export]
    use super::environments::Environments;
    #[pymodule_export]
    use super::experiment::{actuators, builtin_clips, find_field, presets, resolve, tasks};
    #[pymodule_export]
    use super::film::Film;
}
