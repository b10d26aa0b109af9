//! dm_control's recorded rollouts, and the comparison of an environment with them.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use comic_clips::Catalogue;
use comic_experiment::{ClipSource, TRACKING_REWARD_TERMS, Tracking};
use comic_tasks::{Environment, Outcome, Step, TrackingEnvironment, TrackingTask};

use crate::npz::{self, Arrays};

/// What of a file's name says that it is a rollout, kind by kind.
pub(crate) const KINDS: [&str; 2] = ["tracking_", "tracking2019_"];
/// Observations, rewards, errors; dm_control's sums are in another order.
const TOLERANCE: f64 = 1e-12;
/// `gyro_control` takes the arccosine of a number near 1.
const GYRO_TOLERANCE: f64 = 1e-10;

/// The folder of rollouts: `COMIC_GOLDEN_DIR`, or the repository's own.
pub(crate) fn folder() -> PathBuf {
    match std::env::var_os("COMIC_GOLDEN_DIR") {
        // Relative to the workspace, where the command was given.
        Some(folder) => workspace().join(folder),
        None => workspace().join("tests/fixtures/tracking"),
    }
}

fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The files of `folder` that end in `extension`, sorted.
fn files(folder: &Path, extension: &str) -> Result<Vec<PathBuf>, String> {
    let entries = std::fs::read_dir(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let mut paths: Vec<PathBuf> = entries
        .filter_map(|entry| entry.ok().map(|entry| entry.path()))
        .filter(|path| path.extension().is_some_and(|found| found == extension))
        .collect();
    paths.sort();
    Ok(paths)
}

/// The rollouts of one kind.
pub(crate) fn rollouts(folder: &Path, kind: &str) -> Result<Vec<Rollout>, String> {
    let name = |path: &PathBuf| path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    files(folder, "npz")?
        .into_iter()
        .filter(|path| name(path).starts_with(kind) && !name(path).ends_with("_model"))
        .map(|path| Ok(Rollout { folder: folder.into(), file: name(&path), arrays: npz::read(&path)? }))
        .collect()
}

/// One recorded rollout: row 0 after the reset, row n after control step n.
#[derive(Clone)]
pub(crate) struct Rollout {
    folder: PathBuf,
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

    fn array(&self, name: &str) -> Result<&npz::Array, String> {
        self.arrays.get(name).ok_or_else(|| format!("{}: no array `{name}`", self.file))
    }

    fn scalar(&self, name: &str) -> Result<usize, String> {
        let number = self.array(name)?.numbers()?.first().copied();
        let valid = number.filter(|number| number.fract() == 0.0 && (0.0..1e6).contains(number));
        valid.map(|number| number as usize).ok_or_else(|| format!("{}: {name} = {number:?} is no index", self.file))
    }

    /// Names and sizes of the observations, as recorded.
    pub(crate) fn layout(&self) -> Result<Vec<(String, usize)>, String> {
        serde_json::from_str(self.array("obs_layout")?.text()?)
            .map_err(|error| format!("{}: obs_layout: {error}", self.file))
    }

    /// The file that has the rollout's clip.
    fn clip_file(&self, clip: &str) -> Result<PathBuf, String> {
        let wheel = std::env::var_os("COMIC_DM_CONTROL_DIR")
            .map_or_else(|| workspace().join(".deps/dm_control"), |directory| workspace().join(directory));
        let mut candidates = files(&self.folder, "h5")?;
        candidates.push(wheel.join("test_trajectories.h5"));
        let mut searched = Vec::new();
        for path in candidates {
            match Catalogue::open(&[ClipSource::whole(path.to_string_lossy())]) {
                Ok(catalogue) if catalogue.entries().iter().any(|entry| entry.name == clip) => return Ok(path),
                Ok(_) => searched.push(path.display().to_string()),
                Err(error) => searched.push(error.to_string()),
            }
        }
        Err(format!("{}: clip `{clip}` is in none of: {}", self.file, searched.join("; ")))
    }

    fn environment(&self) -> Result<TrackingEnvironment, String> {
        let fail = |error: &dyn std::fmt::Display| format!("{}: {error}", self.file);
        let clip = self.array("clip_id")?.text()?;
        let index = self.scalar("clip")?;
        let layout = self.layout()?;
        let size = |name: &str| layout.iter().find(|(known, _)| known == name).map_or(0, |(_, size)| *size);
        let config = Tracking {
            reference_steps: (1..=size("walker/reference_appendages_pos") / 15).collect(),
            min_steps: 1,
            ..Tracking::default()
        };
        let source =
            ClipSource { ids: vec![clip.into()], ..ClipSource::whole(self.clip_file(clip)?.to_string_lossy()) };
        // The clip's index is an observation. It is the clip's place in the recording's own list, which is not known
        // beyond that: so many copies of the clip put it there.
        let catalogue = Catalogue::open(&vec![source; index + 1]).map_err(|error| fail(&error))?;
        let task = Arc::new(TrackingTask::comparison(&config, &catalogue).map_err(|error| fail(&error))?);
        let mut environment = task.environment(0);
        environment.reset_to(index, self.scalar("start")?).map_err(|error| fail(&error))?;
        Ok(environment)
    }

    /// Compares every number of every row. The first difference is the error, with file, row and quantity.
    pub(crate) fn compare(&self) -> Result<(), String> {
        let channels: Vec<String> = self.array("reward_channels")?.texts()?.to_vec();
        if channels != TRACKING_REWARD_TERMS {
            return Err(format!("{}: reward_channels: {channels:?} recorded", self.file));
        }
        let mut environment = self.environment()?;
        let warm = self.array("qacc_warmstart_after_reset")?.numbers()?;
        self.equal(0, "qacc_warmstart_after_reset", warm, environment.simulation().qacc_warmstart(), 0.0)?;
        self.compare_row(0, &environment, None)?;
        let actions = self.array("actions")?;
        if self.rows() != actions.shape[0] + 1 {
            return Err(format!("{}: {} rows for {} actions", self.file, self.rows(), actions.shape[0]));
        }
        for row in 1..self.rows() {
            let action = <&[f64; 56]>::try_from(actions.row(row - 1)?)
                .map_err(|_| format!("{}: actions: not 56 wide", self.file))?;
            let step = environment.step_control(action);
            self.compare_row(row, &environment, Some(step))?;
        }
        Ok(())
    }

    fn compare_row(&self, row: usize, environment: &TrackingEnvironment, step: Option<Step>) -> Result<(), String> {
        let data = environment.simulation();
        let exact = |name: &str, found: &[f64]| self.equal(row, name, self.array(name)?.row(row)?, found, 0.0);
        let close = |name: &str, found: &[f64]| self.equal(row, name, self.array(name)?.row(row)?, found, TOLERANCE);
        exact("qpos", data.qpos())?;
        exact("qvel", data.qvel())?;
        exact("act", data.act())?;
        exact("time", &[data.time()])?;
        exact("ncon", &[data.contact().len() as f64])?;
        exact("mocap_step", &[environment.frame() as f64])?;
        close("sensordata", data.sensordata())?;
        close("termination_error", &[environment.termination_error()])?;
        self.compare_observations(row, environment)?;
        match step {
            // dm_control gives neither reward nor discount at a reset.
            None => {
                exact("reward", &[f64::NAN])?;
                exact("discount", &[f64::NAN])?;
                exact("reward_terms", &[0.0; 5])?;
                exact("step_type", &[0.0])?;
            }
            Some(step) => {
                close("reward", &[step.reward()])?;
                close("reward_terms", &step.reward_terms)?;
                exact("discount", &[step.discount])?;
                exact("step_type", &[if step.outcome == Outcome::Running { 1.0 } else { 2.0 }])?;
                // Flags of the last step; at a reset dm_control leaves those of the episode before.
                exact("truncate", &[f64::from(u8::from(step.outcome == Outcome::Terminated))])?;
                let episode = environment.episode();
                let at_the_end = environment.frame() == episode.start + episode.steps_left;
                exact("end_mocap", &[f64::from(u8::from(at_the_end))])?;
            }
        }
        Ok(())
    }

    fn compare_observations(&self, row: usize, environment: &TrackingEnvironment) -> Result<(), String> {
        let (layout, dictionary) = (self.layout()?, environment.dictionary());
        let ours: Vec<(String, usize)> =
            dictionary.iter().map(|(name, values)| (name.to_string(), values.len())).collect();
        if layout != ours {
            let other = layout.iter().zip(&ours).find(|(a, b)| a != b);
            return Err(format!("{}: obs_layout: {other:?} (recorded, found)", self.file));
        }
        let mut recorded = self.array("obs")?.row(row)?;
        for (name, found) in &dictionary {
            let (expected, rest) = recorded
                .split_at_checked(found.len())
                .ok_or_else(|| format!("{}: row {row}: obs ends before {name}", self.file))?;
            let tolerance = if *name == "walker/gyro_control" { GYRO_TOLERANCE } else { TOLERANCE };
            self.equal(row, name, expected, found, tolerance)?;
            recorded = rest;
        }
        Ok(())
    }

    fn equal(&self, row: usize, name: &str, expected: &[f64], found: &[f64], tolerance: f64) -> Result<(), String> {
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
