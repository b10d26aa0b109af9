//! Files of dm_control's recorded rollouts: row 0 is after the reset, row n after control step n.

use std::path::{Path, PathBuf};

use comic_tasks::{Outcome, Simulated, Step};

use crate::npz::{self, Arrays};

/// Tolerance of observations, rewards and errors: dm_control sums in another order.
const TOLERANCE: f64 = 1e-12;
/// Tolerance of `gyro_control`, which is the arccosine of a number near 1.
const GYRO_TOLERANCE: f64 = 1e-10;

/// The folder of rollouts: `COMIC_GOLDEN_DIR`, or `tests/fixtures/golden`.
pub(crate) fn folder() -> PathBuf {
    match std::env::var_os("COMIC_GOLDEN_DIR") {
        // A relative path starts at the workspace, where the user gave the command.
        Some(folder) => workspace().join(folder),
        None => committed(),
    }
}

/// The rollouts of this repository.
pub(crate) fn committed() -> PathBuf {
    workspace().join("tests/fixtures/golden")
}

/// The folder of dm_control's compiled models, and of the pictures that its cameras took.
pub(crate) fn models() -> PathBuf {
    workspace().join("tests/fixtures/golden/models")
}

pub(crate) fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The sorted files of `folder` with this extension.
pub(crate) fn files(folder: &Path, extension: &str) -> Result<Vec<PathBuf>, String> {
    let entries = std::fs::read_dir(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let mut paths: Vec<PathBuf> = entries
        .filter_map(|entry| entry.ok().map(|entry| entry.path()))
        .filter(|path| path.extension().is_some_and(|found| found == extension))
        .collect();
    paths.sort();
    Ok(paths)
}

/// The rollouts whose file names have this prefix and this suffix.
pub(crate) fn rollouts(folder: &Path, (prefix, suffix): (&str, &str)) -> Result<Vec<Rollout>, String> {
    let name = |path: &PathBuf| path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    files(folder, "npz")?
        .into_iter()
        .filter(|path| {
            let name = name(path);
            name.starts_with(prefix) && name.ends_with(suffix) && !name.ends_with("_model")
        })
        .map(|path| Ok(Rollout { folder: folder.into(), file: name(&path), arrays: npz::read(&path)? }))
        .collect()
}

/// A recorded rollout.
#[derive(Clone)]
pub(crate) struct Rollout {
    pub(crate) folder: PathBuf,
    pub(crate) file: String,
    pub(crate) arrays: Arrays,
}

impl Rollout {
    /// The recording's first `steps` steps.
    pub(crate) fn head(mut self, steps: usize) -> Self {
        let rows = self.rows();
        for array in self.arrays.values_mut() {
            match array.shape.first() {
                Some(&length) if length == rows => array.truncate(steps + 1),
                Some(&length) if length + 1 == rows && array.shape.len() == 2 => array.truncate(steps),
                _ => {}
            }
        }
        self
    }

    pub(crate) fn rows(&self) -> usize {
        self.arrays.get("qpos").and_then(|array| array.shape.first().copied()).unwrap_or(0)
    }

    pub(crate) fn array(&self, name: &str) -> Result<&npz::Array, String> {
        self.arrays.get(name).ok_or_else(|| format!("{}: no array `{name}`", self.file))
    }

    pub(crate) fn scalar(&self, name: &str) -> Result<usize, String> {
        let number = self.array(name)?.numbers()?.first().copied();
        let valid = number.filter(|number| number.fract() == 0.0 && (0.0..1e6).contains(number));
        valid.map(|number| number as usize).ok_or_else(|| format!("{}: {name} = {number:?} is no index", self.file))
    }

    /// The recorded names and sizes of the observations.
    pub(crate) fn layout(&self) -> Result<Vec<(String, usize)>, String> {
        serde_json::from_str(self.array("obs_layout")?.text()?)
            .map_err(|error| format!("{}: obs_layout: {error}", self.file))
    }

    /// Compares what every task records: the state of the simulation, reward, discount and step type.
    pub(crate) fn compare_common(
        &self,
        row: usize,
        environment: &dyn Simulated,
        step: Option<Step>,
    ) -> Result<(), String> {
        let data = environment.simulation();
        self.exact(row, "qpos", data.qpos())?;
        self.exact(row, "qvel", data.qvel())?;
        self.exact(row, "act", data.act())?;
        self.exact(row, "time", &[data.time()])?;
        self.exact(row, "ncon", &[data.contact().len() as f64])?;
        self.close(row, "sensordata", data.sensordata())?;
        match step {
            // dm_control gives neither reward nor discount at a reset.
            None => {
                self.exact(row, "reward", &[f64::NAN])?;
                self.exact(row, "discount", &[f64::NAN])?;
                self.exact(row, "step_type", &[0.0])
            }
            Some(step) => {
                self.close(row, "reward", &[step.reward()])?;
                self.exact(row, "discount", &[step.discount])?;
                self.exact(row, "step_type", &[if step.outcome == Outcome::Running { 1.0 } else { 2.0 }])
            }
        }
    }

    /// The recorded controls, one for each row except the first.
    pub(crate) fn controls(&self) -> Result<Vec<&[f64; 56]>, String> {
        let actions = self.array("actions")?;
        let count = actions.shape.first().copied().unwrap_or(0);
        if self.rows() != count + 1 {
            return Err(format!("{}: {} rows for {count} actions", self.file, self.rows()));
        }
        let control =
            |row| <&[f64; 56]>::try_from(actions.row(row)?).map_err(|_| format!("{}: actions: not 56 wide", self.file));
        (0..count).map(control).collect()
    }

    pub(crate) fn exact(&self, row: usize, name: &str, found: &[f64]) -> Result<(), String> {
        self.equal(row, name, self.array(name)?.row(row)?, found, 0.0)
    }

    pub(crate) fn close(&self, row: usize, name: &str, found: &[f64]) -> Result<(), String> {
        self.equal(row, name, self.array(name)?.row(row)?, found, TOLERANCE)
    }

    /// Compares names, order and values of the observations.
    pub(crate) fn compare_observations(
        &self,
        row: usize,
        dictionary: &[(&'static str, Vec<f64>)],
    ) -> Result<(), String> {
        let layout = self.layout()?;
        let ours: Vec<(String, usize)> =
            dictionary.iter().map(|(name, values)| (name.to_string(), values.len())).collect();
        if layout != ours {
            let other = layout.iter().zip(&ours).find(|(a, b)| a != b);
            return Err(format!("{}: obs_layout: {other:?} (recorded, found)", self.file));
        }
        let mut recorded = self.array("obs")?.row(row)?;
        for (name, found) in dictionary {
            let (expected, rest) = recorded
                .split_at_checked(found.len())
                .ok_or_else(|| format!("{}: row {row}: obs ends before {name}", self.file))?;
            let tolerance = if *name == "walker/gyro_control" { GYRO_TOLERANCE } else { TOLERANCE };
            self.equal(row, name, expected, found, tolerance)?;
            recorded = rest;
        }
        Ok(())
    }

    pub(crate) fn equal(
        &self,
        row: usize,
        name: &str,
        expected: &[f64],
        found: &[f64],
        tolerance: f64,
    ) -> Result<(), String> {
        let place = format!("{}: row {row}: {name}", self.file);
        if expected.len() != found.len() {
            return Err(format!("{place}: {} numbers recorded, {} found", expected.len(), found.len()));
        }
        for (index, (expected, found)) in expected.iter().zip(found).enumerate() {
            let same = if tolerance == 0.0 {
                expected == found || (expected.is_nan() && found.is_nan())
            } else {
                (expected - found).abs() <= tolerance
            };
            if !same {
                return Err(format!("{place}[{index}]: {expected:?} recorded, {found:?} found"));
            }
        }
        Ok(())
    }
}
