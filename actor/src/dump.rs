//! Writes episodes whose simulation diverged to disk, and reproduces them.

use std::collections::VecDeque;
use std::fmt;
use std::fs::OpenOptions;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use comic_clips::Catalogue;
use comic_experiment::Experiment;
use comic_tasks::{Achievement, Environment, Episode, Outcome, Simulated, Simulation, Step};
use serde::{Deserialize, Serialize};

use crate::Error;

/// Most dumps of a process: one cause makes many similar ones.
const MOST: usize = 16;
/// States before the end that a dump holds.
const LAST: usize = 8;

/// Numbers as text, so that every bit can be restored. JSON's own numbers cannot hold infinities and NaN.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(try_from = "Vec<String>", into = "Vec<String>")]
pub struct Numbers(pub Vec<f64>);

impl From<Numbers> for Vec<String> {
    fn from(Numbers(numbers): Numbers) -> Self {
        numbers.iter().map(f64::to_string).collect()
    }
}

impl TryFrom<Vec<String>> for Numbers {
    type Error = std::num::ParseFloatError;

    fn try_from(text: Vec<String>) -> Result<Self, Self::Error> {
        text.iter().map(|number| number.parse()).collect::<Result<_, _>>().map(Self)
    }
}

/// Compares bit for bit, but all NaN are equal.
impl PartialEq for Numbers {
    fn eq(&self, other: &Self) -> bool {
        let same = |(one, other): (&f64, &f64)| one.to_bits() == other.to_bits() || (one.is_nan() && other.is_nan());
        self.0.len() == other.0.len() && self.0.iter().zip(&other.0).all(same)
    }
}

/// The state of a simulation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Moment {
    /// Generalised positions.
    pub qpos: Numbers,
    /// Generalised velocities.
    pub qvel: Numbers,
    /// The servos' filter states.
    pub act: Numbers,
}

impl Moment {
    fn of(simulation: &Simulation) -> Self {
        let numbers = |values: &[f64]| Numbers(values.to_vec());
        Self { qpos: numbers(simulation.qpos()), qvel: numbers(simulation.qvel()), act: numbers(simulation.act()) }
    }
}

/// An episode that diverged.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dump {
    /// The experiment's document, TOML.
    pub experiment: String,
    /// The task.
    pub task: String,
    /// The clip's index.
    pub clip: usize,
    /// The clip's name.
    pub clip_name: String,
    /// Where the episode began; see [`Episode::start`].
    pub start: usize,
    /// Seed of the environment.
    pub seed: u64,
    /// The simulation's state at its begin.
    pub first: Moment,
    /// The action of every step, `[steps][56]`; the last step diverged.
    pub actions: Vec<Numbers>,
    /// The simulation's state before each of the last steps.
    pub last: Vec<Moment>,
    /// The state after the last step.
    pub end: Moment,
}

/// The result of reproducing a dump's episode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reproduction {
    /// Steps of the dump.
    pub steps: usize,
    /// The step that diverged, counted from 1.
    pub diverged: Option<usize>,
    /// Every state in the dump was reached again, bit for bit.
    pub exact: bool,
}

impl fmt::Display for Reproduction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.diverged {
            Some(step) => write!(f, "diverged in step {step} of {}", self.steps)?,
            None => write!(f, "did not diverge in {} steps", self.steps)?,
        }
        f.write_str(if self.exact {
            ", through the dump's states bit for bit"
        } else {
            ", through other states than the dump's"
        })
    }
}

impl Dump {
    /// Reads a dump.
    ///
    /// # Errors
    /// [`Error::File`], and [`Error::Usage`] when the file is no dump.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let text = std::fs::read(path).map_err(Error::file(path))?;
        serde_json::from_slice(&text)
            .map_err(|error| Error::Usage(format!("{} is no dump of a diverged episode: {error}", path.display())))
    }

    /// Plays the episode again, with these clips if the experiment's own are not available.
    ///
    /// A tracking episode begins at its clip's start, so the states are the same bit for bit. The random draws of other
    /// tasks are not known: their episodes begin in the dump's first state, in a newly drawn arena.
    ///
    /// # Errors
    /// An experiment, clip or state that this release does not have.
    pub fn reproduce(&self, clips: &[String]) -> Result<Reproduction, Error> {
        let experiment = Experiment::from_toml("the dump's experiment", &self.experiment)?.with_clips(clips);
        let task = comic_tasks::build(&experiment, &Catalogue::open(&experiment.clips)?)?;
        let mut environment = task.environment(self.seed)?;
        environment.reset_to(self.clip, self.start)?;
        if Moment::of(environment.simulation()) != self.first {
            self.place(environment.simulation_mut())?;
        }
        let mut reproduction = Reproduction { steps: self.actions.len(), diverged: None, exact: true };
        let unseen = self.actions.len().saturating_sub(self.last.len());
        for (step, Numbers(action)) in self.actions.iter().enumerate() {
            let recorded = step.checked_sub(unseen).and_then(|place| self.last.get(place));
            reproduction.exact &= recorded.is_none_or(|moment| Moment::of(environment.simulation()) == *moment);
            let action: Vec<f32> = action.iter().map(|value| *value as f32).collect();
            if environment.step(&action).outcome == Outcome::Diverged {
                reproduction.diverged = Some(step + 1);
                break;
            }
        }
        Ok(reproduction)
    }

    fn place(&self, simulation: &mut Simulation) -> Result<(), Error> {
        let Moment { qpos: Numbers(qpos), qvel: Numbers(qvel), act: Numbers(act) } = &self.first;
        let sizes = [simulation.qpos().len(), simulation.qvel().len(), simulation.act().len()];
        let found = [qpos.len(), qvel.len(), act.len()];
        if sizes != found {
            return Err(Error::Usage(format!("the dump's states have {found:?} numbers, the task's {sizes:?}")));
        }
        simulation.qpos_mut().copy_from_slice(qpos);
        simulation.qvel_mut().copy_from_slice(qvel);
        simulation.act_mut().copy_from_slice(act);
        simulation.forward();
        Ok(())
    }
}

/// `comic-actor reproduce`.
#[derive(clap::Args, Clone, Debug)]
pub struct Command {
    /// A file that `--dump-diverged` wrote.
    #[arg(value_name = "FILE")]
    dump: PathBuf,
    /// Clips in place of the experiment's own: builtin:NAME, FILE.h5, FILE.h5#SUBSET or FILE.h5#CLIP,CLIP.
    #[arg(long, value_name = "SOURCE", num_args = 1..)]
    clips: Vec<String>,
}

impl Command {
    /// Reproduces the dump's episode and prints the result.
    ///
    /// # Errors
    /// As [`Dump::read`] and [`Dump::reproduce`].
    pub fn run(&self) -> Result<(), Error> {
        let reproduction = Dump::read(&self.dump)?.reproduce(&self.clips)?;
        let line = format!("{reproduction}\n");
        std::io::stdout().write_all(line.as_bytes()).map_err(Error::file("standard output"))
    }
}

/// Writes the dumps of a process.
#[derive(Debug)]
pub struct Dumps {
    directory: PathBuf,
    experiment: String,
    /// The tasks' and the clips' names.
    names: (Vec<String>, Vec<String>),
    written: AtomicUsize,
}

impl Dumps {
    /// Creates the directory.
    ///
    /// # Errors
    /// [`Error::File`] when it cannot be created.
    pub fn new(
        directory: &Path,
        experiment: &Experiment,
        spec: &comic_experiment::TaskSpec,
    ) -> Result<Arc<Self>, Error> {
        std::fs::create_dir_all(directory).map_err(Error::file(directory))?;
        let tasks = spec.tasks.iter().map(|task| task.name.clone()).collect();
        Ok(Arc::new(Self {
            directory: directory.to_path_buf(),
            experiment: experiment.to_toml()?,
            names: (tasks, spec.clips.clone()),
            written: AtomicUsize::new(0),
        }))
    }

    /// Writes a dump if there are not too many yet. A disk error loses the dump only.
    fn write(&self, dump: &Dump) {
        let number = self.written.fetch_add(1, Ordering::Relaxed);
        if number >= MOST {
            return;
        }
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_millis();
        let path = self.directory.join(format!("diverged-{now}-{}-{number}.json", std::process::id()));
        let written = serde_json::to_vec(dump).map_err(std::io::Error::from).and_then(|text| {
            let mut file = OpenOptions::new().write(true).create_new(true).open(&path)?;
            file.write_all(&text)
        });
        let (clip, start, steps) = (&dump.clip_name, dump.start, dump.actions.len());
        match written {
            Ok(()) => tracing::warn!(dump = %path.display(), clip, start, steps, "a simulation diverged"),
            Err(error) => tracing::error!(dump = %path.display(), "a diverged episode could not be dumped: {error}"),
        }
    }

    fn has_room(&self) -> bool {
        self.written.load(Ordering::Relaxed) < MOST
    }
}

/// An environment that records its episode, if diverged episodes are dumped.
#[derive(Debug)]
pub struct Watched {
    environment: Box<dyn Simulated>,
    tape: Option<Tape>,
}

/// The episode so far.
#[derive(Debug)]
struct Tape {
    dumps: Arc<Dumps>,
    seed: u64,
    first: Moment,
    actions: Vec<Numbers>,
    last: VecDeque<Moment>,
}

impl Watched {
    /// Records an environment that was made with `seed`; records nothing without `dumps`.
    pub fn new(environment: Box<dyn Simulated>, dumps: Option<Arc<Dumps>>, seed: u64) -> Self {
        let first = Moment::of(environment.simulation());
        let tape = |dumps| Tape { dumps, seed, first, actions: Vec::new(), last: VecDeque::new() };
        Self { tape: dumps.map(tape), environment }
    }

    fn begin(&mut self) {
        let Self { environment, tape } = self;
        if let Some(tape) = tape {
            tape.first = Moment::of(environment.simulation());
            tape.actions.clear();
            tape.last.clear();
        }
    }
}

impl Tape {
    fn note(&mut self, before: &Simulation, action: &[f32]) {
        if self.last.len() == LAST {
            self.last.pop_front();
        }
        self.last.push_back(Moment::of(before));
        self.actions.push(Numbers(action.iter().map(|value| f64::from(*value)).collect()));
    }

    fn dump(&mut self, episode: Episode, end: &Simulation) {
        let name = |names: &[String], index: usize| names.get(index).cloned().unwrap_or_default();
        let dump = Dump {
            experiment: self.dumps.experiment.clone(),
            task: name(&self.dumps.names.0, episode.task),
            clip: episode.clip,
            clip_name: name(&self.dumps.names.1, episode.clip),
            start: episode.start,
            seed: self.seed,
            first: self.first.clone(),
            actions: std::mem::take(&mut self.actions),
            last: std::mem::take(&mut self.last).into(),
            end: Moment::of(end),
        };
        self.dumps.write(&dump);
    }
}

impl Environment for Watched {
    fn reset(&mut self) {
        self.environment.reset();
        self.begin();
    }

    fn reset_to(&mut self, clip: usize, start: usize) -> Result<(), comic_tasks::Error> {
        self.environment.reset_to(clip, start)?;
        self.begin();
        Ok(())
    }

    fn step(&mut self, action: &[f32]) -> Step {
        let Self { environment, tape } = self;
        // Nothing is recorded when there are enough dumps.
        let mut tape = tape.as_mut().filter(|tape| tape.dumps.has_room());
        if let Some(tape) = &mut tape {
            tape.note(environment.simulation(), action);
        }
        let step = environment.step(action);
        if let (Some(tape), Outcome::Diverged) = (tape, step.outcome) {
            tape.dump(environment.episode(), environment.simulation());
        }
        step
    }

    fn observe(&self, proprioception: &mut [f32], task: &mut [f32]) {
        self.environment.observe(proprioception, task);
    }

    fn draw(&mut self, image: &mut [u8]) -> Result<(), comic_tasks::Error> {
        self.environment.draw(image)
    }

    fn episode(&self) -> Episode {
        self.environment.episode()
    }

    fn record_gradients(&mut self) -> Result<(), comic_tasks::Error> {
        self.environment.record_gradients()
    }

    fn take_gradients(&mut self) -> Vec<[f32; 56]> {
        self.environment.take_gradients()
    }

    fn achievement(&self) -> Achievement {
        self.environment.achievement()
    }

    fn servo_action(&self, action: &mut [f32]) {
        self.environment.servo_action(action);
    }
}

#[cfg(test)]
mod tests;
