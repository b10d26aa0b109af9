//! Clips: list, read, check, import, merge.

use std::path::PathBuf;

use comic_clips::import::{Constants, Floor, Take, import};
use comic_clips::{Catalogue, Clip, ClipWriter, Entry, check, pose_to_action, subsets_with};
use comic_experiment::{ACTION_SIZE, ClipSource, Tracking};
use numpy::{PyArray2, PyReadonlyArray2, PyUntypedArrayMethods as _};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::{refuse, row_by_row};

fn open(sources: &[String]) -> PyResult<Catalogue> {
    let sources: Vec<ClipSource> = sources.iter().map(|source| ClipSource::parse(source)).collect();
    Catalogue::open(&sources).map_err(refuse)
}

/// A dictionary for each clip of the sources, without its motion.
#[pyfunction]
pub(crate) fn list_clips<'py>(python: Python<'py>, sources: Vec<String>) -> PyResult<Vec<Bound<'py, PyDict>>> {
    open(&sources)?.entries().iter().map(|entry| describe(python, entry)).collect()
}

fn describe<'py>(python: Python<'py>, entry: &Entry) -> PyResult<Bound<'py, PyDict>> {
    let task = Tracking::default();
    let starts = entry.starts(task.reference_steps.iter().copied().max().unwrap_or(0), task.min_steps);
    let described = PyDict::new(python);
    described.set_item("clip", &entry.name)?;
    described.set_item("frames", entry.steps)?;
    described.set_item("seconds", entry.dt * entry.steps as f64)?;
    described.set_item("dt", entry.dt)?;
    described.set_item("model", entry.model.to_string())?;
    described.set_item("subsets", subsets_with(&entry.name))?;
    described.set_item("starts", (!starts.is_empty()).then_some((starts.start, starts.end)))?;
    Ok(described)
}

/// A dictionary for each clip of the sources: name, dt, and an array `[T, size]` for each quantity.
#[pyfunction]
pub(crate) fn read_clips<'py>(python: Python<'py>, sources: Vec<String>) -> PyResult<Vec<Bound<'py, PyDict>>> {
    let catalogue = open(&sources)?;
    let read = |index| {
        let clip = python.detach(|| catalogue.load(index)).map_err(refuse)?;
        arrays(python, &clip)
    };
    (0..catalogue.entries().len()).map(read).collect()
}

fn arrays<'py>(python: Python<'py>, clip: &Clip) -> PyResult<Bound<'py, PyDict>> {
    let arrays = PyDict::new(python);
    arrays.set_item("name", &clip.name)?;
    arrays.set_item("dt", clip.dt)?;
    let motion = &clip.motion;
    arrays.set_item("position", array(python, &motion.position))?;
    arrays.set_item("quaternion", array(python, &motion.quaternion))?;
    arrays.set_item("joints", array(python, &motion.joints))?;
    arrays.set_item("velocity", array(python, &motion.velocity))?;
    arrays.set_item("angular_velocity", array(python, &motion.angular_velocity))?;
    arrays.set_item("joints_velocity", array(python, &motion.joints_velocity))?;
    Ok(arrays)
}

fn array<'py, const N: usize>(python: Python<'py>, frames: &[[f64; N]]) -> Bound<'py, PyArray2<f64>> {
    PyArray2::from_owned_array(python, numpy::ndarray::arr2(frames))
}

/// The defects of a file's clips, as JSON.
#[pyfunction]
pub(crate) fn check_clips(python: Python<'_>, source: &str) -> PyResult<String> {
    let ClipSource { source, subset, mut ids, .. } = ClipSource::parse(source);
    if source.starts_with("builtin:") {
        return Err(refuse(format!(
            "{source}: built-in clips are checked by the project's own tests: name an HDF5 file"
        )));
    }
    if let Some(subset) = &subset {
        ids.extend(comic_clips::subset(subset).map_err(refuse)?);
    }
    let checked = python.detach(|| check::check(source.as_ref(), &ids)).map_err(refuse)?;
    serde_json::to_string(&checked).map_err(refuse)
}

/// Makes a file with one clip from CMU's recording. Returns the options that make it again, and remarks.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "the options of `comic-actor clips import`")]
pub(crate) fn import_clip(
    python: Python<'_>,
    asf: PathBuf,
    amc: PathBuf,
    out: PathBuf,
    name: String,
    overwrite: bool,
    scale: Option<f64>,
    sole_degrees: Option<[f64; 2]>,
    floor: Option<String>,
    arm_regularisation: Option<f64>,
    frames: Option<(usize, usize)>,
) -> PyResult<(String, Vec<String>)> {
    let floor = floor.map(|floor| floor.parse::<Floor>()).transpose().map_err(refuse)?;
    let frames = frames.map(|(first, end)| first..end);
    let take = Take { name, asf, amc, constants: Constants { scale, sole_degrees, floor, arm_regularisation, frames } };
    let used = python.detach(|| {
        let mut writer = ClipWriter::create(&out, overwrite)?;
        let (clip, used) = import(&take)?;
        writer.add(&clip)?;
        writer.finish()?;
        Ok::<_, comic_clips::Error>(used)
    });
    let used = used.map_err(refuse)?;
    Ok((used.to_string(), used.notes))
}

/// The actions whose servos aim at poses, `[T, 56]`.
#[pyfunction]
pub(crate) fn poses_to_actions<'py>(
    python: Python<'py>,
    joints: PyReadonlyArray2<'py, f64>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let &[_, ACTION_SIZE] = joints.shape() else {
        return Err(refuse(format!("joints: their shape is {:?}; give [T, {ACTION_SIZE}]", joints.shape())));
    };
    let joints = row_by_row(&joints);
    let (poses, _) = joints.as_chunks::<ACTION_SIZE>();
    let actions: Vec<[f64; ACTION_SIZE]> = poses.iter().map(pose_to_action).collect();
    Ok(array(python, &actions))
}

/// Joins sources in one file, and returns the number of clips.
#[pyfunction]
pub(crate) fn merge_clips(python: Python<'_>, sources: Vec<String>, out: PathBuf, overwrite: bool) -> PyResult<usize> {
    let sources: Vec<ClipSource> = sources.iter().map(|source| ClipSource::parse(source)).collect();
    python.detach(|| comic_clips::merge(&sources, &out, overwrite, |_, _| {})).map_err(refuse)
}
