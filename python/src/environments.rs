//! Several environments of one task, which step in threads without Python's lock.
//!
//! The arrays of a step are made in Rust, filled by the threads and given to numpy, which then owns them. Nothing is
//! copied, and nothing changes them later.

mod buffers;
mod rows;

use std::sync::Arc;

use comic_clips::Catalogue;
use comic_experiment::{ACTION_SIZE, Experiment, IMAGE_SIZE, PROPRIOCEPTION};
use comic_tasks::{Environment as _, Outcome, Simulated, Task};
use numpy::{IntoPyArray as _, PyArray3, PyArrayMethods as _, PyReadonlyArray2, PyUntypedArrayMethods as _};
use parking_lot::Mutex;
use pyo3::exceptions::{PyIndexError, PyRuntimeError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use rayon::prelude::*;

use crate::{experiment, refuse, row_by_row};
use buffers::{Buffers, Slot};
use rows::{Row, Rows};

/// The largest number of steps between two calls for their derivatives: 10 MB for each environment.
const LONGEST_RECORDING: usize = 512;

/// What happens to an environment whose episode is over: Gymnasium's `AutoresetMode`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Autoreset {
    /// The next step resets it, whatever its action is.
    NextStep,
    /// The same step resets it.
    SameStep,
    /// Its owner resets it.
    Disabled,
}

/// One environment.
#[derive(Debug)]
struct Place {
    environment: Box<dyn Simulated>,
    /// Whether the episode is over.
    over: bool,
    /// For each step since the last derivatives: whether it was a step of the simulation, and no reset.
    simulated: Vec<bool>,
}

/// Several environments of one task.
#[pyclass(frozen, module = "comic._native")]
#[derive(Debug)]
pub(crate) struct Environments {
    task: Arc<dyn Task>,
    places: Mutex<Vec<Place>>,
    /// The threads; without them the caller's thread steps.
    pool: Option<rayon::ThreadPool>,
    /// The process that made the threads. A fork of it does not have them.
    process: u32,
    autoreset: Autoreset,
    records_gradients: bool,
    observation_names: Vec<(String, usize)>,
}

#[pymethods]
impl Environments {
    /// `experiment` is TOML. Environment k has the seed `seeds[k]`.
    #[new]
    fn new(
        python: Python<'_>,
        experiment: &str,
        seeds: Vec<u64>,
        threads: usize,
        autoreset: &str,
        record_gradients: bool,
    ) -> PyResult<Self> {
        let experiment = experiment::read(experiment)?;
        let autoreset = match autoreset {
            "NextStep" => Autoreset::NextStep,
            "SameStep" => Autoreset::SameStep,
            "Disabled" => Autoreset::Disabled,
            other => return Err(refuse(format!("autoreset_mode: no mode `{other}`"))),
        };
        if seeds.is_empty() || threads == 0 {
            return Err(refuse("num_envs and threads: both must be at least 1"));
        }
        python.detach(|| {
            let catalogue = Catalogue::open(&experiment.clips).map_err(refuse)?;
            let task = comic_tasks::build(&experiment, &catalogue).map_err(refuse)?;
            // More threads than environments would only wait.
            let threads = threads.min(seeds.len());
            let pool = (threads > 1)
                .then(|| rayon::ThreadPoolBuilder::new().num_threads(threads).build())
                .transpose()
                .map_err(|error| PyRuntimeError::new_err(error.to_string()))?;
            let place = |seed| {
                let mut environment = Arc::clone(&task).environment(seed)?;
                if record_gradients {
                    environment.record_gradients()?;
                }
                Ok::<_, comic_tasks::Error>(Place { environment, over: false, simulated: Vec::new() })
            };
            let places = for_each(pool.as_ref(), seeds, place).map_err(refuse)?;
            let observation_names = observation_names(&experiment, task.as_ref());
            let (places, records_gradients) = (Mutex::new(places), record_gradients);
            let process = std::process::id();
            Ok(Self { task, places, pool, process, autoreset, records_gradients, observation_names })
        })
    }

    /// The parts of an observation, in order: name and size.
    #[getter]
    fn observation_names(&self) -> Vec<(String, usize)> {
        self.observation_names.clone()
    }

    /// Whether the task has camera images.
    #[getter]
    fn has_images(&self) -> bool {
        self.task.spec().image > 0
    }

    /// Names of the reward terms.
    #[getter]
    fn reward_terms(&self) -> Vec<String> {
        self.task.spec().reward_terms.clone()
    }

    /// Names of the clips.
    #[getter]
    fn clips(&self) -> Vec<String> {
        self.task.spec().clips.clone()
    }

    /// Length of a control step, s.
    #[getter]
    fn control_timestep(&self) -> f64 {
        self.task.control_timestep()
    }

    /// Where episodes can start: index of the clip, first frame, end, probability.
    #[getter]
    fn starts(&self) -> Vec<(usize, usize, usize, f64)> {
        let starts = self.task.starts().iter();
        starts.map(|start| (start.clip, start.frames.start, start.frames.end, start.probability)).collect()
    }

    /// Begins an episode in each environment of `chosen`, at `start` (clip and frame) if given. `seeds` come first: an
    /// environment that has one draws from it from now on.
    fn reset<'py>(
        &self,
        python: Python<'py>,
        chosen: Vec<bool>,
        seeds: Vec<Option<u64>>,
        start: Option<(usize, usize)>,
    ) -> PyResult<Bound<'py, PyDict>> {
        self.check_process()?;
        let (rows, buffers) = python.detach(|| {
            let mut places = self.places.lock();
            if chosen.len() != places.len() || seeds.len() != places.len() {
                return Err(refuse(format!("reset_mask and seed: there are {} environments", places.len())));
            }
            let mut buffers = Buffers::new(places.len(), self.task.spec(), false);
            let jobs = places.iter_mut().zip(buffers.slots()).zip(chosen.into_iter().zip(seeds)).collect();
            let rows = self.for_each(jobs, |((place, mut slot), (chosen, seed))| {
                if chosen {
                    place.reset(seed, start)?;
                }
                slot.observe(place.environment.as_mut())?;
                Ok(Row::of_reset(place.environment.as_ref()))
            });
            Ok((rows.map_err(refuse)?, buffers))
        })?;
        self.answer(python, rows, buffers)
    }

    /// One control step of every environment. `actions` is `[N, 56]`.
    fn step<'py>(&self, python: Python<'py>, actions: PyReadonlyArray2<'py, f64>) -> PyResult<Bound<'py, PyDict>> {
        let shape = actions.shape().to_vec();
        let actions = row_by_row(&actions);
        self.check_process()?;
        let (rows, buffers) = python.detach(|| {
            let mut places = self.places.lock();
            if shape != [places.len(), ACTION_SIZE] {
                return Err(refuse(format!("action: its shape is {shape:?}; give [{}, {ACTION_SIZE}]", places.len())));
            }
            if self.autoreset == Autoreset::Disabled
                && let Some(index) = places.iter().position(|place| place.over)
            {
                return Err(refuse(format!("the episode of environment {index} is over: reset it first")));
            }
            if recorded_steps(&places) == LONGEST_RECORDING {
                return Err(PyRuntimeError::new_err(format!(
                    "action_gradient: {LONGEST_RECORDING} steps are recorded; call it before the next step"
                )));
            }
            let mut buffers = Buffers::new(places.len(), self.task.spec(), self.autoreset == Autoreset::SameStep);
            let (actions, _) = actions.as_chunks::<ACTION_SIZE>();
            let jobs = places.iter_mut().zip(buffers.slots()).zip(actions).collect();
            let rows = self.for_each(jobs, |((place, slot), action)| self.step_one(place, slot, action));
            Ok((rows.map_err(refuse)?, buffers))
        })?;
        self.answer(python, rows, buffers)
    }

    /// The derivatives since the last call, `[N, T, 56]`; 0 for a step that reset its environment.
    fn take_gradients<'py>(&self, python: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        if !self.records_gradients {
            return Err(PyRuntimeError::new_err(
                "action_gradient: nothing was recorded; make the environment with record_gradients=True",
            ));
        }
        self.check_process()?;
        let (gradients, shape) = python.detach(|| {
            let mut places = self.places.lock();
            let shape = [places.len(), recorded_steps(&places), ACTION_SIZE];
            let taken = self.for_each(places.iter_mut().collect(), |place| Ok(place.take_gradients()));
            let taken = taken.map_err(refuse)?.into_iter().collect::<Option<Vec<_>>>();
            let taken = taken.ok_or_else(|| PyRuntimeError::new_err("action_gradient: this task has no derivative"))?;
            Ok::<_, PyErr>((taken.concat().into_flattened(), shape))
        })?;
        gradients.into_pyarray(python).reshape(shape)
    }

    /// Generalised positions, velocities and the servos' filter states of environment `index`, in MuJoCo's order.
    fn state(&self, index: usize) -> PyResult<[Vec<f64>; 3]> {
        let places = self.places.lock();
        let simulation = place(&places, index)?.environment.simulation();
        Ok([simulation.qpos().to_vec(), simulation.qvel().to_vec(), simulation.act().to_vec()])
    }
}

impl Environments {
    /// Calls `draw` with environment `index`.
    pub(crate) fn with<T>(&self, index: usize, draw: impl FnOnce(&mut dyn Simulated) -> PyResult<T>) -> PyResult<T> {
        let mut places = self.places.lock();
        place(&places, index)?;
        draw(places[index].environment.as_mut())
    }

    fn check_process(&self) -> PyResult<()> {
        if self.pool.is_some() && self.process != std::process::id() {
            return Err(PyRuntimeError::new_err(
                "the threads of these environments are in the process that made them; make the environments after the fork, or with threads=1",
            ));
        }
        Ok(())
    }

    fn for_each<J: Send, R: Send>(
        &self,
        jobs: Vec<J>,
        work: impl Fn(J) -> Result<R, comic_tasks::Error> + Send + Sync,
    ) -> Result<Vec<R>, comic_tasks::Error> {
        for_each(self.pool.as_ref(), jobs, work)
    }

    fn step_one(&self, place: &mut Place, mut slot: Slot<'_>, action: &[f64; 56]) -> Result<Row, comic_tasks::Error> {
        if self.records_gradients {
            place.simulated.push(!place.over);
        }
        if place.over {
            place.reset(None, None)?;
            slot.observe(place.environment.as_mut())?;
            return Ok(Row::of_reset(place.environment.as_ref()));
        }
        let step = place.environment.step_control(action);
        place.over = step.outcome != Outcome::Running;
        let row = Row::of_step(step, place.environment.as_ref());
        if !place.over || self.autoreset != Autoreset::SameStep {
            slot.observe(place.environment.as_mut())?;
            return Ok(row);
        }
        slot.observe_last(place.environment.as_mut())?;
        place.reset(None, None)?;
        slot.observe(place.environment.as_mut())?;
        Ok(row.and_reset(place.environment.as_ref()))
    }

    fn answer<'py>(&self, python: Python<'py>, rows: Vec<Row>, buffers: Buffers) -> PyResult<Bound<'py, PyDict>> {
        let answer = Rows::new(&rows, self.task.spec().reward_terms.len()).into_dict(python)?;
        buffers.add_to(&answer, [rows.len(), IMAGE_SIZE, IMAGE_SIZE, 3])?;
        Ok(answer)
    }
}

impl Place {
    fn reset(&mut self, seed: Option<u64>, start: Option<(usize, usize)>) -> Result<(), comic_tasks::Error> {
        if let Some(seed) = seed {
            self.environment.reseed(seed);
        }
        match start {
            None => self.environment.reset(),
            Some((clip, start)) => self.environment.reset_to(clip, start)?,
        }
        self.over = false;
        Ok(())
    }

    /// One derivative for each step, also for those that were resets; `None` in a task without a derivative.
    fn take_gradients(&mut self) -> Option<Vec<[f32; ACTION_SIZE]>> {
        let simulated = std::mem::take(&mut self.simulated);
        let mut gradients = self.environment.take_gradients().into_iter();
        let absent = gradients.len() == 0 && simulated.contains(&true);
        let next = |simulated| if simulated { gradients.next().unwrap_or([0.0; 56]) } else { [0.0; 56] };
        (!absent).then(|| simulated.into_iter().map(next).collect())
    }
}

/// Steps since the last derivatives; 0 if none are recorded.
fn recorded_steps(places: &[Place]) -> usize {
    places.first().map_or(0, |place| place.simulated.len())
}

fn place(places: &[Place], index: usize) -> PyResult<&Place> {
    places.get(index).ok_or_else(|| PyIndexError::new_err(format!("there are {} environments", places.len())))
}

/// Does all jobs, in the pool's threads if there is one. The results have the order of the jobs.
fn for_each<J: Send, R: Send, E: Send>(
    pool: Option<&rayon::ThreadPool>,
    jobs: Vec<J>,
    work: impl Fn(J) -> Result<R, E> + Send + Sync,
) -> Result<Vec<R>, E> {
    match pool {
        None => jobs.into_iter().map(work).collect(),
        // A job takes a quarter of a millisecond, and some take ten times as long, so each is its own piece.
        Some(pool) => pool.install(|| jobs.into_par_iter().with_max_len(1).map(work).collect()),
    }
}

/// The parts of an observation. In joint training the second half differs from task to task, so it is one part.
fn observation_names(experiment: &Experiment, task: &dyn Task) -> Vec<(String, usize)> {
    let own = PROPRIOCEPTION.iter().map(|(name, size)| ((*name).to_owned(), *size));
    let parts = match experiment.joint.is_empty() {
        true => experiment.observations(experiment.task).unwrap_or_default(),
        false => vec![("task".to_owned(), task.spec().task)],
    };
    own.chain(parts).collect()
}
