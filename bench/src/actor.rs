//! Environments, policies, resets, images, and the path of an unroll into a batch. Each figure is the median of short
//! segments, in which value and floor take turns, so that other programs on the machine slow down both.
//!
//! The floor of most figures is the physics alone: the same model with the same starts and controls, which a recording
//! environment ([`tape`]) keeps.

mod acting;
mod clips;
mod memory;
mod physics;
mod tape;
mod vision;
mod wire;

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, Result};
use clap::{Args, ValueEnum};
use comic_clips::Catalogue;
use comic_experiment::{Experiment, LowLevelName, TaskName};
use comic_tasks::{Simulated, Task};

/// Environments of a thread.
const ENVIRONMENTS: usize = 16;

/// Measure how fast an actor is
///
/// `ratio` is value / floor. `actor.env` and `actor.policy`: steps/s with resets, against the same controls through the
/// physics alone. `actor.gradient`: steps/s with the simulator's derivative, against those without it; the quickstart's
/// networks. `actor.contended`: steps/s of one thread alone, against those beside busy processes, one for each core or `--beside`.
/// `actor.threads`: steps/s of two threads, against one. `actor.reset`: ms. `actor.wire`: ms of one core
/// for sending the unrolls of one update from a worker into a batch, against one second. `actor.vision`: ms of an image.
/// `actor.memory`: resident MiB after 10,000 resets, against those after 1,000. `actor.memory.reset`: ms of one of the
/// last thousand resets, against one of the first. `clips.step`, `clips.memory` and `clips.load`, for each number of `--clips`:
/// µs of a control step, resident MiB of a process, and ms until its task can be stepped; copies of the built-in recordings.
/// `against_first` compares with the first number of clips.
#[derive(Args, Clone, Debug)]
pub struct Bench {
    /// Seconds for each figure
    #[arg(long, default_value_t = 15.0)]
    seconds: f64,
    /// The task: tracking, go-to-target, gaps, walls, get-up or ball-catch
    #[arg(long, default_value_t = TaskName::Tracking)]
    task: TaskName,
    /// The low level of the policy: mlp, lstm, mixture or product. All but mlp add their name to the figure's
    #[arg(long, default_value_t = LowLevelName::Mlp)]
    low_level: LowLevelName,
    /// Busy processes of equal priority beside `actor.contended` [default: one for each core]
    #[arg(long, value_name = "N")]
    beside: Option<usize>,
    #[command(flatten)]
    clips: clips::Options,
    /// Figures to measure [default: all but vision, memory and clips]
    #[arg(value_enum)]
    figures: Vec<Name>,
}

/// A figure's name, without `actor.`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Name {
    Env,
    Policy,
    Gradient,
    Contended,
    Threads,
    Reset,
    Wire,
    Vision,
    Memory,
    Clips,
}

/// What is measured: the paper's networks on one task.
struct Subject {
    experiment: Experiment,
    task: Arc<dyn Task>,
    budget: Duration,
    /// Busy neighbours.
    beside: usize,
}

impl Subject {
    fn environment(&self, seed: u64) -> Result<Box<dyn Simulated>> {
        Ok(Arc::clone(&self.task).environment(seed)?)
    }
}

impl Bench {
    /// Measures and prints.
    ///
    /// # Errors
    /// A task that cannot be built; an error of MuJoCo, OpenGL or libtorch.
    pub fn run(&self) -> Result<()> {
        let budget =
            Duration::try_from_secs_f64(self.seconds).with_context(|| format!("--seconds {}", self.seconds))?;
        let paper = comic_experiment::resolve(&format!("tracking-{}", self.low_level), &[])?;
        if let Some(file) = &self.clips.load_clips {
            return clips::load(&paper, file);
        }
        let experiment = Experiment { task: self.task, ..paper };
        let catalogue = Catalogue::open(&experiment.clips)?;
        let task = comic_tasks::build(&experiment, &catalogue)?;
        let beside = self.beside.map_or_else(crate::busy::cores, Ok)?;
        let subject = Subject { experiment, task, budget, beside };
        // Images need OpenGL, which not every machine has. Memory and clips take minutes.
        let wanted = |name: &&Name| match self.figures.as_slice() {
            [] => !matches!(name, Name::Vision | Name::Memory | Name::Clips),
            figures => figures.contains(name),
        };
        for name in Name::value_variants().iter().filter(wanted) {
            let figures = match name {
                Name::Env => vec![physics::environment(&subject)?],
                Name::Policy => vec![acting::policy(&subject)?],
                Name::Gradient => vec![acting::gradient(&subject)?],
                Name::Contended => vec![acting::contended(&subject)?],
                Name::Threads => vec![acting::threads(&subject)?],
                Name::Reset => vec![physics::reset(&subject)?],
                Name::Wire => vec![wire::wire(&subject)?],
                Name::Vision => vec![vision::vision(&subject)?],
                Name::Memory => memory::memory(&subject)?.into(),
                Name::Clips => {
                    // Clips are tracked, whatever the task of the other figures is.
                    clips::clips(&subject, &self.clips)?;
                    Vec::new()
                }
            };
            for figure in figures {
                figure.named_after(self.low_level).print()?;
            }
        }
        Ok(())
    }
}
