//! `cargo xtask sweep`: trains an experiment with varied fields, and compares the results.

mod board;
mod document;
mod outcome;
mod plan;
mod table;

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::sync_channel;
use std::thread;

use anyhow::{Context, Result, bail};
use comic_setup::Interrupt;

use crate::train::display::Display;
use crate::{plot, train, workspace};
use board::Board;
use document::Document;
use outcome::Outcome;
use plan::{Point, Run};
use table::Row;

#[derive(clap::Args)]
pub(crate) struct Options {
    /// The file of the sweep; docs/sweeps has examples
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Directory of the runs, tables and curves [default: runs/sweep-FILE]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

/// Trains and evaluates the runs that are not finished, and prints the table.
pub(crate) fn run(options: Options) -> Result<()> {
    let name = options.file.file_stem().unwrap_or_default().to_string_lossy();
    let out = options.out.unwrap_or_else(|| workspace::root().join("runs").join(format!("sweep-{name}")));
    let sweep = Sweep::plan(&options.file, &out)?;
    train::prepare()?;
    let interrupt = Interrupt::install()?;
    let ended = sweep.run(&interrupt, |run, display| {
        run.job.train(display, &interrupt)?;
        if interrupt.requested() {
            bail!("interrupted");
        }
        run.job.evaluate(display, &interrupt).map(drop)
    });
    println!("\n{}\nwritten to {}", table::markdown(&sweep.rows()), sweep.directory.display());
    ended
}

/// All runs of a sweep.
struct Sweep {
    directory: PathBuf,
    /// Runs at the same time.
    parallel: usize,
    points: Vec<Point>,
    runs: Vec<Run>,
}

impl Sweep {
    /// Reads the file. Refuses it if one of its runs would be refused.
    fn plan(file: &Path, out: &Path) -> Result<Self> {
        let document = Document::read(file)?;
        let directory = std::path::absolute(out).with_context(|| format!("no such path: {}", out.display()))?;
        let points = plan::points(&document);
        let runs = plan::runs(&document, &points, &directory).with_context(|| file.display().to_string())?;
        Ok(Self { directory, parallel: document.parallel.get(), points, runs })
    }

    /// Calls `train` for every run that is not finished, for several at the same time, and writes the tables after each.
    /// A run that fails does not stop the others; a request to stop does.
    fn run(&self, interrupt: &Interrupt, train: impl Fn(&Run, &mut Display) -> Result<()> + Sync) -> Result<()> {
        let left: Vec<&Run> = self.runs.iter().filter(|run| !run.finished()).collect();
        let board = Board::new(self.runs.len(), self.runs.len() - left.len());
        let next = AtomicUsize::new(0);
        let mut failed = Vec::new();
        thread::scope(|scope| {
            let (report, reports) = sync_channel(1);
            for _ in 0..self.parallel.min(left.len()) {
                let report = report.clone();
                let (left, next, board, train) = (&left, &next, &board, &train);
                scope.spawn(move || {
                    while !interrupt.requested()
                        && let Some(run) = left.get(next.fetch_add(1, Ordering::Relaxed))
                    {
                        let mut display = board.display(run);
                        let outcome = train(run, &mut display).and_then(|()| run.outcome());
                        show(display, &outcome, interrupt.requested());
                        // The receiver exists as long as there is a sender.
                        let _ = report.send((run, outcome.is_ok()));
                    }
                });
            }
            drop(report);
            for (run, finished) in reports {
                if finished {
                    board.count();
                } else {
                    failed.push(run.name.as_str());
                }
                // The tables are written again at the end, where an error is reported.
                let _ = self.write_tables();
            }
        });
        board.finish();
        self.write_tables()?;
        let finished = self.runs.iter().filter(|run| run.finished()).count();
        if interrupt.requested() {
            bail!(
                "interrupted; {finished} of {} runs are finished, the same command resumes the sweep",
                self.runs.len()
            );
        }
        if !failed.is_empty() {
            bail!(
                "{} of {} runs failed ({}); the same command tries them again; their logs are in {}",
                failed.len(),
                self.runs.len(),
                failed.join("; "),
                self.directory.display()
            );
        }
        Ok(())
    }

    fn rows(&self) -> Vec<Row<'_>> {
        Row::all(&self.points, &self.runs)
    }

    /// Writes both tables and the picture of the finished runs.
    fn write_tables(&self) -> Result<()> {
        let rows = self.rows();
        let write = |name: &str, text: String| {
            let path = self.directory.join(name);
            fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))
        };
        fs::create_dir_all(&self.directory).with_context(|| format!("cannot make {}", self.directory.display()))?;
        write("table.md", table::markdown(&rows))?;
        write("table.json", serde_json::to_string_pretty(&table::json(&rows))?)?;
        let groups: Vec<_> = self
            .points
            .iter()
            .enumerate()
            .map(|(index, point)| {
                let runs = self.runs.iter().filter(|run| run.point == index && run.finished());
                (point.name(), runs.map(|run| plot::Source::of(run.job.metrics())).collect())
            })
            .collect();
        // Runs of a sweep may share the machine, so their wall-clock times do not compare.
        let (quantities, axes) = ([plot::Quantity::NormalisedReward], [plot::Axis::EnvironmentSteps]);
        plot::draw_groups(&groups, &quantities, &axes, &self.directory.join("curves.svg"))
    }
}

/// Shows how a run ended.
fn show(display: Display, outcome: &Result<Outcome>, interrupted: bool) {
    match outcome {
        Ok(outcome) => {
            display.conclude("finished", &[("normalised reward", format!("{:.3}", outcome.normalised_reward))]);
        }
        Err(_) if interrupted => display.conclude("stopped", &[]),
        Err(error) => display.conclude("failed", &[("reason", format!("{error:#}"))]),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Barrier, Mutex};

    use serde_json::json;

    use super::*;

    /// A directory with a sweep over two values and two seeds, and the runs that were trained in it.
    struct Trial {
        directory: tempfile::TempDir,
        trained: Mutex<Vec<String>>,
    }

    const ALL: [&str; 4] = ["beta=0,seed=1", "beta=0,seed=2", "beta=1e-4,seed=1", "beta=1e-4,seed=2"];

    impl Trial {
        fn new() -> Self {
            let trial = Self { directory: tempfile::tempdir().unwrap(), trained: Mutex::default() };
            trial.write("preset = \"quickstart\"\nseeds = [1, 2]\n[grid]\n\"latent.beta\" = [0, 1e-4]\n");
            trial
        }

        fn write(&self, text: &str) {
            fs::write(self.directory.path().join("sweep.toml"), text).unwrap();
        }

        fn plan(&self) -> Result<Sweep> {
            Sweep::plan(&self.directory.path().join("sweep.toml"), &self.directory.path().join("out"))
        }

        /// Writes the files of a finished run.
        fn train(&self, run: &Run) -> Result<()> {
            self.begin(run);
            let overall = json!({
                "clip": "overall", "episodes": 1, "length_mean": 30.0, "return_mean": 1.0, "normalised_reward": run.seed,
                "reward_per_step": 0.5, "fraction_survived": 1.0, "reward_terms": {},
            });
            let evaluation = json!({ "trained": { "clips": [], "overall": overall } }).to_string();
            fs::write(run.job.path().join("evaluation.json"), evaluation)?;
            Ok(())
        }

        /// Writes the files of an interrupted run.
        fn begin(&self, run: &Run) {
            self.trained.lock().unwrap().push(run.name.clone());
            fs::create_dir_all(run.job.path().join("checkpoints")).unwrap();
            let experiment = run.job.experiment().to_toml().unwrap();
            fs::write(run.job.path().join("experiment.toml"), experiment).unwrap();
            let line = json!({ "seconds": 60, "environment_steps": 1000, "normalised_reward": 0.5 }).to_string();
            fs::write(run.job.path().join("metrics.jsonl"), line + "\n").unwrap();
        }

        /// The runs that were trained since the last call.
        fn trained(&self) -> Vec<String> {
            let mut names = std::mem::take(&mut *self.trained.lock().unwrap());
            names.sort();
            names
        }

        fn out(&self, name: &str) -> String {
            fs::read_to_string(self.directory.path().join("out").join(name)).unwrap()
        }
    }

    #[test]
    fn the_sweeps_in_the_docs_are_valid() {
        let files = fs::read_dir(workspace::root().join("docs/sweeps")).unwrap();
        for file in files.map(|file| file.unwrap().path()) {
            Sweep::plan(&file, tempfile::tempdir().unwrap().path()).unwrap();
        }
    }

    #[test]
    fn every_run_is_trained_once_and_is_in_the_tables() {
        let trial = Trial::new();
        trial.plan().unwrap().run(&Interrupt::default(), |run, _| trial.train(run)).unwrap();
        assert_eq!(trial.trained(), ALL);
        assert!(trial.out("table.md").contains("| 1e-4 | 1, 2 | 1.500 (1.000–2.000) | 0.500 |"));
        let table: serde_json::Value = serde_json::from_str(&trial.out("table.json")).unwrap();
        assert_eq!(table[1]["normalised_reward"]["mean"], 1.5);
        assert!(trial.out("curves.svg").contains("beta=1e-4"));
    }

    #[test]
    fn finished_runs_are_not_trained_again() {
        let trial = Trial::new();
        trial.plan().unwrap().run(&Interrupt::default(), |run, _| trial.train(run)).unwrap();
        trial.trained();
        trial.plan().unwrap().run(&Interrupt::default(), |run, _| trial.train(run)).unwrap();
        assert!(trial.trained().is_empty());
    }

    #[test]
    fn a_run_that_fails_does_not_stop_the_others_and_is_tried_again() {
        let trial = Trial::new();
        let train = |run: &Run, _: &mut Display| if run.name == ALL[1] { bail!("diverged") } else { trial.train(run) };
        let error = trial.plan().unwrap().run(&Interrupt::default(), train).unwrap_err().to_string();
        assert!(error.starts_with("1 of 4 runs failed (beta=0,seed=2)"), "{error}");
        assert_eq!(trial.trained().len(), 3);
        trial.plan().unwrap().run(&Interrupt::default(), |run, _| trial.train(run)).unwrap();
        assert_eq!(trial.trained(), [ALL[1]]);
    }

    #[test]
    fn an_interrupted_sweep_starts_no_other_run_and_is_resumed() {
        let trial = Trial::new();
        let interrupt = Interrupt::default();
        let train = |run: &Run, _: &mut Display| {
            trial.begin(run);
            interrupt.request();
            bail!("interrupted")
        };
        let error = trial.plan().unwrap().run(&interrupt, train).unwrap_err().to_string();
        assert_eq!(error, "interrupted; 0 of 4 runs are finished, the same command resumes the sweep");
        assert_eq!(trial.trained(), [ALL[0]]);
        trial.plan().unwrap().run(&Interrupt::default(), |run, _| trial.train(run)).unwrap();
        assert_eq!(trial.trained(), ALL);
    }

    #[test]
    fn as_many_runs_as_the_file_says_run_at_the_same_time() {
        let trial = Trial::new();
        trial.write("preset = \"quickstart\"\nparallel = 2\nseeds = [1, 2]");
        let both = Barrier::new(2);
        let train = |run: &Run, _: &mut Display| {
            both.wait();
            trial.train(run)
        };
        trial.plan().unwrap().run(&Interrupt::default(), train).unwrap();
        assert_eq!(trial.trained(), ["seed=1", "seed=2"]);
    }

    #[test]
    fn a_file_that_differs_from_its_runs_is_refused() {
        let trial = Trial::new();
        trial.plan().unwrap().run(&Interrupt::default(), |run, _| trial.train(run)).unwrap();
        trial.write("preset = \"quickstart\"\n[set]\nbudget.minutes = 1\n[grid]\n\"latent.beta\" = [0]\n");
        let error = format!("{:#}", trial.plan().err().unwrap());
        assert!(error.contains("sweep.toml: beta=0,seed=1: ") && error.contains("budget.minutes"), "{error}");
    }
}
