//! `comic-actor clips`: lists, checks, imports, edits, merges and fetches motion capture.
//!
//! # Layout
//! One file for each sub-command. It parses and prints; `comic-clips` does the work. Only `download` uses the network.

mod check;
mod download;
mod fetch;
mod import;
mod join;
mod list;
mod merge;
mod mirror;
mod speed;
mod table;

use std::io::Write as _;

use clap::{Args, Subcommand};

pub use download::{Expected, download};

use crate::Error;

const EXIT_CODES: &str = "\
Exit codes: 0 when done, 1 when `check` found defects or a download failed, 2 when files or arguments are wrong.";

/// Lists, checks, imports, edits, merges and fetches motion capture.
#[derive(Args, Clone, Debug)]
#[command(after_help = EXIT_CODES)]
pub struct Clips {
    #[command(subcommand)]
    command: Command,
}

#[derive(Clone, Debug, Subcommand)]
enum Command {
    /// Lists the clips of a file: names, frames, seconds, subsets, starts.
    List(list::List),
    /// Finds every defect of a file's clips: penetration, floating, joint limits, jumps, NaN.
    Check(check::Check),
    /// Makes clips from motion capture: ASF and AMC, BVH, or SMPL files.
    Import(Box<import::Import>),
    /// Writes mirrored clips: left and right exchanged.
    Mirror(mirror::Mirror),
    /// Writes faster or slower clips.
    Speed(speed::Speed),
    /// Writes clips with the legs of one clip and the arms of another.
    Join(join::Join),
    /// Merges the clips of several files into one.
    Merge(merge::Merge),
    /// Fetches DeepMind's clips of 2020, 455 MiB.
    Fetch(fetch::Fetch),
}

impl Clips {
    /// Runs the sub-command.
    ///
    /// # Errors
    /// The sub-command's errors; [`Error::Defects`] when `check` finds defects.
    pub fn run(&self) -> Result<(), Error> {
        match &self.command {
            Command::List(list) => list.run(),
            Command::Check(check) => check.run(),
            Command::Import(import) => import.run(),
            Command::Mirror(mirror) => mirror.run(),
            Command::Speed(speed) => speed.run(),
            Command::Join(join) => join.run(),
            Command::Merge(merge) => merge.run(),
            Command::Fetch(fetch) => fetch.run(),
        }
    }
}

fn print(text: &str) -> Result<(), Error> {
    std::io::stdout().write_all(text.as_bytes()).map_err(Error::file("standard output"))
}

fn print_json(value: &impl serde::Serialize) -> Result<(), Error> {
    let json = serde_json::to_string_pretty(value)
        .map_err(|error| Error::Usage(format!("cannot write the answer as JSON: {error}")))?;
    print(&(json + "\n"))
}
