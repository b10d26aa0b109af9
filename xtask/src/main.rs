//! `cargo xtask`: set-up, tests, training, benchmarks and plots from one program.
//!
//! # Layout
//! - [`setup`] fills `.deps` with the native libraries; everything else calls it first.
//! - [`check`] runs the tests and the linters; [`images`] builds the Docker images for some of the tests, and [`durations`]
//!   says what took the time.
//! - [`documentation`] builds the pages of the crates and the book.
//! - [`fuzz`] feeds random bytes to everything that reads bytes from outside.
//! - [`train`] runs one learner and its actors on this machine and shows their progress.
//! - [`sweep`] trains with varied fields of an experiment, and compares the runs.
//! - [`mod@bench`] measures; [`python`] runs other people's code for comparison.
//! - [`wheel`] builds the Python package, and [`dist`] all files of a release.
//! - [`plot`] draws learning curves; [`metrics`] and [`evaluations`] read the files that it draws.
//! - [`film`] makes the film of the README, and [`low_level`] the built-in low level.
//!
//! This program runs before libtorch and MuJoCo are installed, so it links neither.

mod bench;
mod check;
mod dist;
mod documentation;
mod durations;
mod evaluations;
mod film;
mod fuzz;
mod images;
mod low_level;
mod metrics;
mod plot;
mod python;
mod setup;
mod sweep;
mod train;
mod wheel;
mod workspace;

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

#[derive(Parser)]
#[command(name = "cargo xtask", about = "Set up, test, train and measure CoMic", disable_help_subcommand = true)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Fetch libmujoco, libtorch and the humanoid into .deps
    Setup(setup::Options),
    /// Set up and run every test
    Test(check::TestOptions),
    /// Check formatting, run clippy and check the licences of dependencies; a warning is an error
    Lint,
    /// Build rustdoc's pages, a warning being an error, and the book of docs/
    Docs,
    /// Feed random bytes to everything that reads bytes from outside, guided by the code that they reach
    Fuzz(fuzz::Options),
    /// Set up, build, and train with one learner and its actors on this machine
    Train(train::Options),
    /// Train an experiment with varied fields and several seeds, and compare the runs
    Sweep(sweep::Options),
    /// Measure; one JSON line for each figure
    Bench(bench::Options),
    /// Draw the curves of runs, or of other files of metrics, in one picture; beside training, which has noise, a run's
    /// evaluations without noise
    Plot {
        /// Files of metrics, such as `runs/NAME/metrics.jsonl`; `LABEL=FILE` names a curve, and `FILE#TASK` draws one task
        /// of joint training
        #[arg(required = true)]
        metrics: Vec<String>,
        /// The quantities to draw, separated by commas, one below the other
        #[arg(long = "y", value_enum, value_delimiter = ',', default_value = "episode-return")]
        quantities: Vec<plot::Quantity>,
        /// Draw files that have the same label, and all files without one, as one curve: their mean, and a band with its
        /// 95 % bootstrap interval. They should differ in their seeds only
        #[arg(long)]
        seeds: bool,
        /// Draw the evaluations of one run, clip by clip, as a heat map in place of curves
        #[arg(long, conflicts_with_all = ["quantities", "seeds"])]
        clips: bool,
        /// The picture
        #[arg(long, default_value = "curves.svg")]
        out: PathBuf,
    },
    /// Set up, build, and make the film of the README from a checkpoint
    Film(film::Options),
    /// Set up, build, and make the built-in low level again: train, fit its prior, measure it, and write it with its card
    LowLevel(low_level::Options),
    /// Set up, and build the Python package as a wheel in target/wheels
    Wheel,
    /// Set up, build, and make all files of a release: archives, wheel, bills of materials, notes and checksums
    Dist(dist::Options),
    /// Make the tests' fixtures again with the scripts in tests/python
    Fixtures(python::FixtureOptions),
    /// Become a program that gets SIGTERM when the process PARENT ends
    #[command(hide = true)]
    Child(train::child::Options),
}

fn main() -> ExitCode {
    let result = match Arguments::parse().command {
        Command::Setup(options) => setup::run(&options),
        Command::Test(options) => check::test(&options),
        Command::Lint => check::lint(),
        Command::Docs => documentation::build(),
        Command::Fuzz(options) => fuzz::fuzz(&options),
        Command::Train(options) => train::run(options),
        Command::Sweep(options) => sweep::run(options),
        Command::Bench(options) => bench::run(&options),
        Command::Plot { metrics, clips: true, out, .. } => plot::clips(&metrics, &out),
        Command::Plot { metrics, quantities, seeds, out, .. } => plot::run(&metrics, &quantities, seeds, &out),
        Command::Film(options) => film::run(&options),
        Command::LowLevel(options) => low_level::run(options),
        Command::Wheel => wheel::build().map(|wheel| println!("{}", wheel.display())),
        Command::Dist(options) => dist::run(&options),
        Command::Fixtures(options) => python::fixtures(&options),
        Command::Child(options) => train::child::run(&options),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
