//! `cargo xtask train`: one learner and its actors on this machine, watched to the end, and what was learnt.

mod display;
mod evaluation;
pub(crate) mod metrics;
mod process;
mod run_directory;
mod supervisor;

use std::net::TcpListener;
use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use comic_experiment::Experiment;

use crate::interrupt::Interrupt;
use crate::{plot, setup, workspace};
use display::Display;
use run_directory::RunDirectory;
use supervisor::Supervisor;

#[derive(clap::Args)]
pub(crate) struct Options {
    /// A preset's name or the path of an experiment file
    #[arg(long, default_value = "quickstart", value_name = "NAME|FILE")]
    preset: String,
    /// Clips to track instead of the experiment's: builtin:NAME, FILE.h5, FILE.h5#SUBSET or FILE.h5#CLIP,CLIP
    #[arg(long, num_args = 1.., value_name = "SOURCE")]
    clips: Vec<String>,
    /// Override any field of the experiment, for instance --set vmpo.epsilon_eta=0.2
    #[arg(long = "set", value_name = "FIELD=VALUE")]
    overrides: Vec<String>,
    /// Actor processes
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u16).range(1..=1024))]
    actors: u16,
    /// Directory of the run [default: runs/PRESET-1, -2, …]
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// The learner's port [default: the first free one from 7070 on]
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..))]
    port: Option<u16>,
    /// Minutes to train, instead of the experiment's budget
    #[arg(long)]
    minutes: Option<f64>,
    /// Episodes of each clip in the evaluations at the end [default: every start frame once]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    episodes: Option<u32>,
    /// Go on with a run: the one named by --run, or else the preset's newest
    #[arg(long)]
    resume: bool,
}

/// What the learner is started with.
struct Job {
    experiment: Experiment,
    /// `--preset`, `--clips` and `--set` as the learner takes them.
    document: Vec<String>,
    actors: u16,
    episodes: Option<u32>,
    port: Option<u16>,
    directory: RunDirectory,
}

/// Trains, and prints what was learnt.
pub(crate) fn run(options: Options) -> Result<()> {
    let job = Job::new(options)?;
    setup::run(&setup::Options::default())?;
    workspace::build()?;
    let interrupt = Interrupt::install()?;
    job.directory.make()?;
    // Chosen only now: the build takes minutes, and a port that was free before it may be taken.
    let port = job.port.map_or_else(free_port, Ok)?;
    let mut display = Display::new(&job.experiment.budget);
    display.event("starting", &[("run", job.directory.path().display().to_string()), ("port", port.to_string())]);
    let outcome = Supervisor::start(&job, port, &mut display, &interrupt).and_then(|mut supervisor| {
        let outcome = supervisor.watch(&mut display, &interrupt);
        supervisor.stop(&mut display);
        outcome
    });
    display.finish();
    let metrics = job.directory.metrics();
    if metrics.exists() {
        let curve = job.directory.path().join("curve.svg");
        match plot::run(&[metrics.display().to_string()], plot::Quantity::EpisodeReturn, &curve) {
            Ok(()) => {}
            Err(error) => eprintln!("no curve: {error:#}"),
        }
    }
    outcome?;
    evaluation::compare(&job, &interrupt)
}

impl Job {
    fn new(options: Options) -> Result<Self> {
        let mut overrides = options.overrides;
        if let Some(minutes) = options.minutes {
            overrides.push(format!("budget.minutes={minutes:?}"));
        }
        // Resolved here too, so that a wrong field is refused before anything is fetched or built.
        let experiment = comic_experiment::resolve(&options.preset, &overrides)?;
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
            port: options.port,
            directory,
        })
    }
}

fn absolute_if_file(preset: &str) -> Result<String> {
    if comic_experiment::presets::ALL.iter().any(|(name, _)| *name == preset) {
        return Ok(preset.to_owned());
    }
    let path = std::path::absolute(preset).with_context(|| format!("cannot find {preset}"))?;
    Ok(path.display().to_string())
}

/// The first free port from 7070 on. All are below 32768: a listening port inside the ephemeral range can meet a TCP
/// self-connect.
fn free_port() -> Result<u16> {
    for port in 7070..7170 {
        if TcpListener::bind(("127.0.0.1", port)).is_ok() {
            return Ok(port);
        }
    }
    bail!("no port from 7070 to 7169 is free; name one by --port")
}
