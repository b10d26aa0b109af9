//! `cargo xtask train`: one learner and its actors on this machine, from the start to the evaluation.

pub(crate) mod child;
pub(crate) mod display;
pub(crate) mod evaluation;
pub(crate) mod preemption;
mod process;
mod run_directory;
mod supervisor;

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU16, Ordering};

use anyhow::{Context, Result, bail};
use comic_experiment::Experiment;
use comic_setup::Interrupt;

use crate::evaluations::Evaluation;
use crate::{plot, setup, workspace};
use display::Display;
use preemption::Preemption;
use run_directory::RunDirectory;
use supervisor::Supervisor;

#[derive(clap::Args)]
pub(crate) struct Options {
    /// A preset's name or the path of an experiment file
    #[arg(long, default_value = "quickstart", value_name = "NAME|FILE")]
    pub(crate) preset: String,
    /// Clips to track instead of the experiment's: builtin:NAME, FILE.h5, FILE.h5#SUBSET or FILE.h5#CLIP,CLIP
    #[arg(long, num_args = 1.., value_name = "SOURCE")]
    pub(crate) clips: Vec<String>,
    /// Override any field of the experiment, for instance --set vmpo.epsilon_eta=0.2
    #[arg(long = "set", value_name = "FIELD=VALUE")]
    pub(crate) overrides: Vec<String>,
    /// Number of actor processes
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(crate) actors: u16,
    /// Directory of the run [default: runs/PRESET-1, -2, …]
    #[arg(long, value_name = "DIR")]
    pub(crate) run: Option<PathBuf>,
    /// The learner's port [default: the first free one from 7070 on]
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) port: Option<u16>,
    /// Minutes to train, instead of the experiment's budget
    #[arg(long)]
    pub(crate) minutes: Option<f64>,
    /// Episodes of each clip in the evaluations at the end [default: every start frame once]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) episodes: Option<u32>,
    /// Start no process beside the actors that evaluates the newest checkpoint every few minutes, without noise
    #[arg(long)]
    pub(crate) no_evaluator: bool,
    /// Resume the run that --run names, or the preset's newest run
    #[arg(long)]
    pub(crate) resume: bool,
}

/// One run: the learner's arguments and the directory.
pub(crate) struct Job {
    experiment: Experiment,
    /// `--preset`, `--clips` and `--set`, as the learner reads them.
    document: Vec<String>,
    actors: u16,
    episodes: Option<u32>,
    /// Whether a process evaluates checkpoints during training.
    evaluator: bool,
    /// Whether the logs have each unroll, and the accounting at the end.
    logs_unrolls: bool,
    port: Option<u16>,
    directory: RunDirectory,
}

/// Trains, and prints the evaluation.
pub(crate) fn run(options: Options) -> Result<()> {
    let job = Job::new(options)?;
    prepare()?;
    let interrupt = Interrupt::install()?;
    let mut display = Display::new(&job.experiment.budget);
    let outcome = job.train(&mut display, &interrupt);
    display.finish();
    outcome?;
    let evaluations = job.evaluate(&mut display, &interrupt)?;
    println!("{}\nkept in {}", evaluation::table(&evaluations), job.path().display());
    println!("page: {}", job.directory.page().display());
    Ok(())
}

/// Sets up and builds.
pub(crate) fn prepare() -> Result<()> {
    setup::run(&setup::Options::default())?;
    workspace::build(&workspace::PROGRAMS)
}

impl Job {
    /// Resolves the experiment. A wrong field is refused before anything is fetched or built.
    pub(crate) fn new(options: Options) -> Result<Self> {
        let mut overrides = options.overrides;
        if let Some(minutes) = options.minutes {
            overrides.push(format!("budget.minutes={minutes:?}"));
        }
        let experiment = comic_experiment::resolve(&options.preset, &overrides)?.with_clips(&options.clips);
        let directory = RunDirectory::choose(options.run, &experiment.name, options.resume)?;
        let mut document = vec!["--preset".to_owned(), absolute_if_file(&options.preset)?];
        for setting in &overrides {
            document.extend(["--set".to_owned(), setting.clone()]);
        }
        if !options.clips.is_empty() {
            document.push("--clips".to_owned());
            document.extend(options.clips);
        }
        Ok(Self {
            experiment,
            document,
            actors: options.actors,
            episodes: options.episodes,
            evaluator: !options.no_evaluator,
            logs_unrolls: false,
            port: options.port,
            directory,
        })
    }

    /// The same, with lines in the actors' logs for each unroll that is made and acknowledged, and the accounting in the learner's.
    pub(crate) fn with_unrolls_in_logs(self) -> Self {
        Self { logs_unrolls: true, ..self }
    }

    /// The experiment.
    pub(crate) fn experiment(&self) -> &Experiment {
        &self.experiment
    }

    /// The run's directory.
    pub(crate) fn path(&self) -> &Path {
        self.directory.path()
    }

    /// The run's file of metrics, which may not exist yet.
    pub(crate) fn metrics(&self) -> PathBuf {
        self.directory.metrics()
    }

    /// The newest checkpoint, if there is one.
    pub(crate) fn newest_checkpoint(&self) -> Option<PathBuf> {
        self.directory.newest_checkpoint()
    }

    /// The learner's log.
    pub(crate) fn learner_log(&self) -> PathBuf {
        self.directory.log("learner")
    }

    /// The logs of the actors.
    pub(crate) fn actor_logs(&self) -> Vec<PathBuf> {
        (0..usize::from(self.actors)).map(|number| self.directory.log(&supervisor::actor_name(number))).collect()
    }

    /// Trains until the budget is used up or a stop is requested, and draws the run.
    pub(crate) fn train(&self, display: &mut Display, interrupt: &Interrupt) -> Result<()> {
        self.train_preempted(&mut Preemption::none(), display, interrupt)
    }

    /// As [`train`](Self::train), while processes are killed and replaced.
    pub(crate) fn train_preempted(
        &self,
        preemption: &mut Preemption,
        display: &mut Display,
        interrupt: &Interrupt,
    ) -> Result<()> {
        self.directory.make()?;
        // The port is chosen after the build, which takes minutes: another program may take a port in that time.
        let port = self.port.map_or_else(free_port, Ok)?;
        display.event("starting", &[("directory", self.path().display().to_string()), ("port", port.to_string())]);
        let outcome = Supervisor::start(self, port, preemption, display, interrupt).and_then(|mut supervisor| {
            let outcome = supervisor.watch(display, interrupt);
            supervisor.stop(display);
            outcome
        });
        if self.metrics().exists() {
            self.draw(display);
        }
        outcome
    }

    /// Draws the curve, and a picture of the clips if there are several. Training has not failed if a picture fails.
    fn draw(&self, display: &mut Display) {
        let (curve, clips) = (self.path().join("curve.svg"), self.path().join("clips.svg"));
        match plot::draw_runs(&[plot::Source::of(self.metrics())], &[plot::Quantity::NormalisedReward], &curve) {
            Ok(()) => display.event("drew", &[("curve", curve.display().to_string())]),
            Err(error) => display.event("no curve", &[("reason", format!("{error:#}"))]),
        }
        match plot::draw_clips(&self.directory.evaluations(), &clips) {
            Ok(true) => display.event("drew", &[("clips", clips.display().to_string())]),
            Ok(false) => {}
            Err(error) => display.event("no picture of the clips", &[("reason", format!("{error:#}"))]),
        }
    }

    /// Evaluates the run's policies without noise and writes `evaluation.json`.
    pub(crate) fn evaluate(&self, display: &mut Display, interrupt: &Interrupt) -> Result<Vec<(String, Evaluation)>> {
        evaluation::compare(self, display, interrupt)
    }
}

fn absolute_if_file(preset: &str) -> Result<String> {
    if comic_experiment::presets::ALL.iter().any(|(name, _)| *name == preset) {
        return Ok(preset.to_owned());
    }
    let path = std::path::absolute(preset).with_context(|| format!("cannot find {preset}"))?;
    Ok(path.display().to_string())
}

/// The first free port from 7070 on that this program has not chosen before: runs at the same time choose before their
/// learners listen. All ports are below 32768, since in the ephemeral range a connection could connect to itself.
fn free_port() -> Result<u16> {
    static TAKEN: AtomicU16 = AtomicU16::new(0);
    for _ in 0..PORTS {
        let port = 7070 + TAKEN.fetch_add(1, Ordering::Relaxed) % PORTS;
        if TcpListener::bind(("127.0.0.1", port)).is_ok() {
            return Ok(port);
        }
    }
    bail!("no port from 7070 to {} is free; name one by --port", 7070 + PORTS - 1)
}

/// Number of ports that are tried.
const PORTS: u16 = 100;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_at_the_same_time_get_different_ports() {
        let ports: std::collections::BTreeSet<u16> = (0..5).map(|_| free_port().unwrap()).collect();
        assert_eq!(ports.len(), 5);
    }
}
