//! The figures of `comic-actor bench`: one JSON line each, medians of short interleaved segments.
//!
//! A figure stands beside its floor, measured in the same run: the physics alone, on the same model and the very same
//! controls and starts (a tape records them). Other programs on the machine then slow both down alike.

mod acting;
mod figure;
mod memory;
mod physics;
mod tape;
mod vision;
mod wire;

use std::sync::Arc;
use std::time::Duration;

use clap::{Args, ValueEnum};
use comic_clips::Catalogue;
use comic_experiment::{Experiment, LowLevelName, TaskName};
use comic_tasks::{Simulated, Task};

use crate::Error;

/// Environments a thread wherever a policy acts.
const ENVIRONMENTS: usize = 16;

/// Measures how fast an actor is.
///
/// `ratio` is always value / floor. `actor.env`, `actor.policy`: steps/s, resets included, against the same controls
/// through the physics alone. `actor.threads`: steps/s of two threads against one. `actor.reset`: ms. `actor.wire`: ms
/// of one core that an update's worth of unrolls costs between a worker and a batch, against one second.
/// `actor.vision`: ms an image. `actor.memory`: MiB held after 10,000 resets against those after 1,000, and
/// `actor.memory.reset` what one of the last thousand cost against one of the first.
#[derive(Args, Clone, Debug)]
pub struct Bench {
    /// Seconds for each figure.
    #[arg(long, default_value_t = 15.0)]
    seconds: f64,
    /// The task: tracking, go-to-target, gaps, walls, get-up or ball-catch.
    #[arg(long, default_value_t = TaskName::Tracking)]
    task: TaskName,
    /// The low level of what acts: mlp, lstm, mixture or product; another than the MLP adds its name to the figure's.
    #[arg(long, default_value_t = LowLevelName::Mlp)]
    low_level: LowLevelName,
    /// Only these figures.
    #[arg(value_enum)]
    figures: Vec<Name>,
}

/// A figure's name, without `actor.`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Name {
    Env,
    Policy,
    Threads,
    Reset,
    Wire,
    Vision,
    Memory,
}

/// What all figures are measured on: the paper's networks, one built-in walk or another task.
struct Subject {
    experiment: Experiment,
    task: Arc<dyn Task>,
    budget: Duration,
}

impl Subject {
    fn environment(&self, seed: u64) -> Result<Box<dyn Simulated>, comic_tasks::Error> {
        Arc::clone(&self.task).environment(seed)
    }
}

impl Bench {
    /// Measures and prints.
    ///
    /// # Errors
    /// Whatever keeps it from that.
    pub fn run(&self) -> Result<(), Error> {
        let budget = Duration::try_from_secs_f64(self.seconds)
            .map_err(|error| Error::Usage(format!("--seconds {}: {error}", self.seconds)))?;
        let paper = comic_experiment::resolve(&format!("tracking-{}", self.low_level), &[])?;
        let experiment = Experiment { task: self.task, ..paper };
        let catalogue = Catalogue::open(&experiment.clips)?;
        let task = comic_tasks::build(&experiment, &catalogue)?;
        let subject = Subject { experiment, task, budget };
        // Images need OpenGL, which a machine that only counts steps may lack, and memory minutes: when asked for.
        let wanted = |name: &&Name| match self.figures.as_slice() {
            [] => !matches!(name, Name::Vision | Name::Memory),
            figures => figures.contains(name),
        };
        for name in Name::value_variants().iter().filter(wanted) {
            let figures = match name {
                Name::Env => vec![physics::environment(&subject)?],
                Name::Policy => vec![acting::policy(&subject)?],
                Name::Threads => vec![acting::threads(&subject)?],
                Name::Reset => vec![physics::reset(&subject)?],
                Name::Wire => vec![wire::wire(&subject)?],
                Name::Vision => vec![vision::vision(&subject)?],
                Name::Memory => memory::memory(&subject)?.into(),
            };
            for figure in figures {
                figure.of(self.low_level).print()?;
            }
        }
        Ok(())
    }
}
