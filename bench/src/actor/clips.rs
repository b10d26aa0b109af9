//! What more clips cost an actor: time of a step, memory and loading.

use std::fs::File;
use std::hint::black_box;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use comic_clips::{Catalogue, ClipWriter, WalkerModel, builtin_names};
use comic_experiment::{ClipSource, Experiment, TaskName};
use comic_tasks::raw_physics::RawPhysics;
use comic_tasks::{Environment, Outcome, Task};
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::Subject;
use super::memory::resident;
use super::tape::{Recorded, Tape};
use crate::median::median;

/// Control steps of a segment: a fifth of a second of computing.
const STEPS: usize = 512;
/// The smallest number of segments of a median.
const FEWEST_SEGMENTS: usize = 5;
/// Processes that load each file, one after the other.
const LOADS: usize = 3;
/// Numbers in a frame besides the bodies' positions and orientations: coordinates 63, velocities 62, centre of mass 3, end
/// effectors 12, appendages 15.
const NUMBERS: usize = 155;
/// Numbers of a body in a frame: position and orientation.
const BODY_NUMBERS: usize = 7;
const MIB: f64 = 1_048_576.0;

/// The options of this measurement.
#[derive(Args, Clone, Debug)]
pub(super) struct Options {
    /// Numbers of clips, for `clips`. Each is compared with the first
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [2, 24, 200, 836])]
    clips: Vec<usize>,
    /// Only loads this file, and prints what that took
    #[arg(long, hide = true)]
    pub(super) load_clips: Option<PathBuf>,
}

/// What a process says that loaded the clips of a file and stepped an environment.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct Loaded {
    /// From opening the file to a task that can be stepped, ms.
    load: f64,
    /// Reading the bytes of the file, ms.
    read: f64,
    /// Resident memory, MiB.
    resident: f64,
}

/// Some number of clips, and its measurements.
struct Size {
    clips: usize,
    file: PathBuf,
    /// Frames of all clips.
    frames: usize,
    loads: Vec<Loaded>,
    stepped: Stepped,
}

/// Measures and prints.
pub(super) fn clips(subject: &Subject, options: &Options) -> Result<()> {
    ensure!(options.clips.iter().all(|clips| *clips > 0), "--clips: there must be at least one clip");
    let directory = tempfile::tempdir().context("no temporary directory")?;
    let mut sizes = Vec::new();
    for clips in &options.clips {
        let file = directory.path().join(format!("{clips}.h5"));
        let frames = write(&file, *clips)?;
        let stepped = Stepped::new(&task(&subject.experiment, &file)?)?;
        sizes.push(Size { clips: *clips, file, frames, loads: Vec::new(), stepped });
    }
    for _ in 0..LOADS {
        for size in &mut sizes {
            size.loads.push(in_a_process(&size.file)?);
        }
    }
    // The first segments warm up and are not counted.
    for size in &mut sizes {
        let _ = size.stepped.segment();
    }
    let budget = subject.budget * u32::try_from(sizes.len())?;
    let (begin, mut segments) = (Instant::now(), 0);
    while segments < FEWEST_SEGMENTS || begin.elapsed() < budget {
        for Size { stepped, .. } in &mut sizes {
            let (value, floor) = stepped.segment();
            stepped.values.push(value);
            stepped.floors.push(floor);
        }
        segments += 1;
    }
    let first = sizes.first().context("--clips names no number")?;
    sizes.iter().flat_map(|size| size.lines(first)).for_each(|line| println!("{line}"));
    Ok(())
}

/// Writes so many copies of the built-in recordings, each with a name of its own. Returns the number of frames.
fn write(path: &Path, clips: usize) -> Result<usize> {
    // `stand` and the short names of the recordings do not begin like this.
    let recorded = builtin_names().into_iter().filter(|name| name.starts_with("CMU_"));
    let sources: Vec<ClipSource> = recorded.map(|name| ClipSource::whole(format!("builtin:{name}"))).collect();
    let catalogue = Catalogue::open(&sources)?;
    let mut writer = ClipWriter::create(path, false)?;
    let mut frames = 0;
    for copy in 0..clips {
        let mut clip = catalogue.load(copy % catalogue.entries().len().max(1))?;
        clip.name = format!("{}_copy_{copy}", clip.name);
        frames += clip.steps();
        writer.add(&clip)?;
    }
    writer.finish()?;
    Ok(frames)
}

/// The tracking task with all clips of a file.
fn task(experiment: &Experiment, file: &Path) -> Result<Arc<dyn Task>> {
    let clips = vec![ClipSource::whole(file.display().to_string())];
    let experiment = Experiment { task: TaskName::Tracking, clips, ..experiment.clone() };
    Ok(comic_tasks::build(&experiment, &Catalogue::open(&experiment.clips)?)?)
}

/// Loads a file in a process of its own, so that nothing else is in its memory.
fn in_a_process(file: &Path) -> Result<Loaded> {
    let mut command = Command::new(std::env::current_exe()?);
    command.arg("--load-clips").arg(file).stdin(Stdio::null()).stderr(Stdio::inherit());
    let output = command.output().context("cannot start another process")?;
    ensure!(output.status.success(), "the process that loads {} ended with {}", file.display(), output.status);
    serde_json::from_slice(&output.stdout).context("the process that loads clips printed something else")
}

/// Loads a file, steps an environment, and prints [`Loaded`].
pub(super) fn load(experiment: &Experiment, file: &Path) -> Result<()> {
    let begin = Instant::now();
    let task = task(experiment, file)?;
    let load = milliseconds(begin.elapsed());
    let mut stepped = Stepped::new(&task)?;
    stepped.step();
    let resident = resident()?;
    // Last, because its memory would count.
    let begin = Instant::now();
    read(file)?;
    let loaded = Loaded { load, read: milliseconds(begin.elapsed()), resident };
    println!("{}", serde_json::to_string(&loaded)?);
    Ok(())
}

/// Reads all bytes of a file.
fn read(path: &Path) -> Result<()> {
    let mut file = File::open(path).with_context(|| format!("cannot open {}", path.display()))?;
    let mut buffer = vec![0; 1 << 20];
    while file.read(&mut buffer).with_context(|| format!("cannot read {}", path.display()))? > 0 {
        black_box(&mut buffer);
    }
    Ok(())
}

fn milliseconds(time: Duration) -> f64 {
    1000.0 * time.as_secs_f64()
}

/// An environment with random starts and actions, and its physics alone.
struct Stepped {
    environment: Recorded,
    tape: Tape,
    floor: RawPhysics,
    random: Pcg64,
    actions: Vec<f32>,
    /// Numbers of an action.
    width: usize,
    proprioception: Vec<f32>,
    task: Vec<f32>,
    /// µs of a control step, and of its physics alone.
    values: Vec<f64>,
    floors: Vec<f64>,
}

impl Stepped {
    fn new(task: &Arc<dyn Task>) -> Result<Self> {
        let spec = task.spec();
        let (mut environment, tape) = Recorded::new(Arc::clone(task).environment(1)?);
        environment.reset();
        Ok(Self {
            environment,
            tape,
            floor: RawPhysics::default(),
            random: Pcg64::seed_from_u64(1),
            actions: vec![0.0; STEPS * spec.action],
            width: spec.action.max(1),
            proprioception: vec![0.0; spec.proprioception],
            task: vec![0.0; spec.task],
            values: Vec::new(),
            floors: Vec::new(),
        })
    }

    /// Makes [`STEPS`] steps with observations and resets. Uniformly random actions end an episode soon, so the next one starts in
    /// another clip.
    fn step(&mut self) {
        let random = &mut self.random;
        self.actions.fill_with(|| random.random_range(-1.0..1.0));
        for action in self.actions.chunks_exact(self.width) {
            let step = self.environment.step(action);
            self.environment.observe(&mut self.proprioception, &mut self.task);
            if step.outcome != Outcome::Running {
                self.environment.reset();
                self.environment.observe(&mut self.proprioception, &mut self.task);
            }
        }
    }

    /// µs of a control step, and of its physics alone.
    fn segment(&mut self) -> (f64, f64) {
        let begin = Instant::now();
        self.step();
        let value = 1000.0 * milliseconds(begin.elapsed()) / STEPS as f64;
        let begin = Instant::now();
        let steps = self.tape.play(&mut self.floor);
        (value, 1000.0 * milliseconds(begin.elapsed()) / steps.max(1) as f64)
    }
}

impl Size {
    fn loaded(&self, number: impl Fn(&Loaded) -> f64) -> f64 {
        median(self.loads.iter().map(number).collect())
    }

    /// The numbers of all clips, 8 bytes each, MiB.
    fn numbers(&self) -> f64 {
        let frame = 8 * (NUMBERS + BODY_NUMBERS * WalkerModel::Cmu2020.bodies());
        (self.frames * frame) as f64 / MIB
    }

    /// The figures, compared with those of the first size.
    fn lines(&self, first: &Self) -> [serde_json::Value; 3] {
        let line = |name: &str, unit: &str, value: f64, floor: f64, of_first: f64, note: &str| {
            json!({
                "figure": format!("clips.{name}.{}", self.clips), "value": value, "unit": unit, "floor": floor,
                "ratio": value / floor, "against_first": value / of_first, "clips": self.clips, "frames": self.frames,
                "note": note,
            })
        };
        let step = |size: &Self| median(size.stepped.values.clone());
        let resident = |size: &Self| size.loaded(|loaded| loaded.resident);
        let load = |size: &Self| size.loaded(|loaded| loaded.load);

        let steps = line(
            "step",
            "us",
            step(self),
            median(self.stepped.floors.clone()),
            step(first),
            "a control step, random starts and actions, resets and observations included; floor: 6 x mj_step + mj_forward",
        );
        let mut memory = line(
            "memory",
            "MiB",
            resident(self),
            resident(first) + self.numbers() - first.numbers(),
            resident(first),
            "resident memory of a process with one environment; floor: that with the first number of clips, and the numbers \
             of the other clips at 8 bytes",
        );
        if self.frames > first.frames {
            let bytes = MIB * (resident(self) - resident(first)) / (self.frames - first.frames) as f64;
            memory["bytes_per_frame"] = json!(bytes);
        }
        let loads = line(
            "load",
            "ms",
            load(self),
            self.loaded(|loaded| loaded.read),
            load(first),
            "opening the file, reading its clips, compiling the model; floor: reading the bytes of the file",
        );
        [steps, memory, loads]
    }
}
