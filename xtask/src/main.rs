//! `cargo xtask`: set-up, tests, training, benchmarks and plots from one entry.
//!
//! # Layout
//! - [`setup`] fills `.deps` with the native libraries; everything else calls it first.
//! - [`check`] runs the tests and the linters; [`images`] builds what some of them run.
//! - [`fuzz`] feeds hostile bytes to whatever reads bytes from outside.
//! - [`train`] runs one learner and its actors on this machine and shows what they do.
//! - [`sweep`] does so with some of an experiment's fields varied, and compares.
//! - [`bench`] and [`python`] make the figures of the README, [`plot`] its curves.
//!
//! This program runs before there is a libtorch or a MuJoCo, so it links neither.

mod bench;
mod check;
mod fuzz;
mod images;
mod plot;
mod python;
mod setup;
mod sweep;
mod train;
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
    /// Check formatting and run clippy, warnings being errors
    Lint,
    /// Feed hostile bytes to everything that reads some, guided by the code that they reach
    Fuzz(fuzz::Options),
    /// Set up, build, and train with one learner and its actors on this machine
    Train(train::Options),
    /// Train an experiment with some of its fields varied, with several seeds, and compare
    Sweep(sweep::Options),
    /// Measure; one JSON line per figure
    Bench(bench::Options),
    /// Draw the curves of runs, or of ../shared/baselines, as one picture
    Plot {
        /// Files of metrics, `runs/NAME/metrics.jsonl`; `LABEL=FILE` gives a curve its name, and `#TASK`
        /// behind it draws one task of joint training
        #[arg(required = true)]
        metrics: Vec<String>,
        /// What the curves show; several, with commas between them, are drawn one below the other
        #[arg(long = "y", value_enum, value_delimiter = ',', default_value = "episode-return")]
        quantities: Vec<plot::Quantity>,
        /// The picture
        #[arg(long, default_value = "curves.svg")]
        out: PathBuf,
    },
    /// Make the tests' fixtures anew by the scripts in tests/python
    Fixtures(python::FixtureOptions),
}

fn main() -> ExitCode {
    let result = match Arguments::parse().command {
        Command::Setup(options) => setup::run(&options),
        Command::Test(options) => check::test(&options),
        Command::Lint => check::lint(),
        Command::Fuzz(options) => fuzz::fuzz(&options),
        Command::Train(options) => train::run(options),
        Command::Sweep(options) => sweep::run(options),
        Command::Bench(options) => bench::run(&options),
        Command::Plot { metrics, quantities, out } => plot::run(&metrics, &quantities, &out),
        Command::Fixtures(options) => python::fixtures(&options),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
