//! `cargo xtask bench preemption`: a run on machines that are taken away. Actors are killed at random and replaced, and so is the
//! learner, once. Afterwards every unroll is looked for in the accounting, and the curve is compared with that of a quiet run.

mod accounts;
mod learner;
mod lines;
mod logs;

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use clap::Parser as _;
use comic_experiment::{Budget, Experiment};
use comic_setup::Interrupt;
use serde_json::json;

use crate::train::display::Display;
use crate::train::preemption::{LearnerKilled, Preemption};
use crate::train::{self, Job};
use crate::{metrics, plot};
use accounts::Unrolls;

/// Training with `comic-learner` and `comic-actor`, whose processes are killed with SIGKILL and replaced after five seconds
#[derive(clap::Parser)]
#[command(name = "cargo xtask bench preemption --", no_binary_name = true)]
struct Options {
    /// Minutes to train
    #[arg(long, value_name = "M", default_value_t = 20.0)]
    minutes: f64,
    /// Environment steps to train on, instead of minutes: the experiment's schedules then do not depend on how fast the machine is
    #[arg(long, value_name = "N", conflicts_with = "minutes")]
    environment_steps: Option<u64>,
    /// Number of actor processes, each with one thread and four environments
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..=1024))]
    actors: u16,
    /// Percent of the actors that are killed each minute
    #[arg(long, value_name = "PERCENT", default_value_t = 5.0, value_parser = percent)]
    rate: f64,
    /// Never kill the learner, which is otherwise killed once, in the middle third of the budget
    #[arg(long)]
    keep_learner: bool,
    /// Kill nothing: a run to compare with
    #[arg(long, conflicts_with_all = ["rate", "keep_learner"])]
    quiet: bool,
    /// Decides which actors are killed, and when; the experiment's own is `--set seed=N`
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// A preset's name or the path of an experiment file
    #[arg(long, default_value = "quickstart", value_name = "NAME|FILE")]
    preset: String,
    /// Override any field of the experiment
    #[arg(long = "set", value_name = "FIELD=VALUE")]
    overrides: Vec<String>,
    /// Directory of the run [default: runs/PRESET-1, -2, …]
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// Directory of a finished run with the same budget, for instance a quiet one: the curve of this run must be like its curve
    #[arg(long, value_name = "DIR")]
    compare: Option<PathBuf>,
    /// Most reward per step, as a mean over the last third, by which the two curves may differ
    #[arg(long, value_name = "REWARD", default_value_t = 0.05, value_parser = tolerance, requires = "compare")]
    tolerance: f64,
}

/// Checkpoints that are kept: all of them, in any run that ends.
const KEPT: usize = 1 << 20;

/// Most percent a minute: each actor once a second.
const HIGHEST_RATE: f64 = 6000.0;

fn percent(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| (0.0..=HIGHEST_RATE).contains(number));
    number.ok_or_else(|| format!("a number from 0 to {HIGHEST_RATE}"))
}

fn tolerance(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| (0.0..=1.0).contains(number));
    number.ok_or_else(|| "a number from 0 to 1".into())
}

/// Trains, kills, and prints the figures.
///
/// # Errors
/// When the run fails, when an unroll is missing from the accounting, when the run ended before the learner was killed, and when
/// its curve is not like the other one.
pub(super) fn run(arguments: &[String]) -> Result<()> {
    let options = Options::parse_from(arguments);
    let job = options.job()?;
    ensure!(job.experiment().budget != Budget::default(), "the budget has no limit, so the run would never end");
    if let Some(other) = &options.compare {
        refuse_another_experiment(job.experiment(), other)?;
    }
    train::prepare()?;
    let interrupt = Interrupt::install()?;
    let mut display = Display::new(&job.experiment().budget);
    let mut preemption = options.preemption(job.experiment());
    let outcome = job.train_preempted(&mut preemption, &mut display, &interrupt);
    display.finish();
    outcome?;
    if interrupt.requested() {
        bail!("interrupted; the run is in {}", job.path().display());
    }
    let unrolls = Unrolls::of(&job)?;
    options.print(&job, &preemption, &unrolls)?;
    let difference = options.compare.as_ref().map(|other| compare(job.path(), other));
    unrolls.check(preemption.learner_killed.is_some())?;
    if !options.quiet && !options.keep_learner && preemption.learner_killed.is_none() {
        bail!("the run ended before the learner was killed: give it more time");
    }
    difference.map_or(Ok(()), |difference| judge(difference?, options.tolerance))
}

impl Options {
    fn job(&self) -> Result<Job> {
        let budget = match self.environment_steps {
            Some(steps) => format!("budget.environment_steps={steps}"),
            None => format!("budget.minutes={:?}", self.minutes),
        };
        // Without minutes only the steps count. What the user sets has precedence, but the checkpoint from which the learner is
        // resumed is read at the end.
        let ours = ["actor.threads=1", "actor.environments=4", "budget.minutes=0", &budget].map(String::from);
        let kept = [format!("learner.checkpoints_kept={KEPT}")];
        let job = Job::new(train::Options {
            preset: self.preset.clone(),
            clips: Vec::new(),
            overrides: ours.into_iter().chain(self.overrides.iter().cloned()).chain(kept).collect(),
            actors: self.actors,
            run: self.run.clone(),
            port: None,
            minutes: None,
            episodes: None,
            no_evaluator: true,
            resume: false,
        })?;
        Ok(job.with_unrolls_in_logs())
    }

    fn preemption(&self, experiment: &Experiment) -> Preemption {
        if self.quiet {
            return Preemption::none();
        }
        let preemption = Preemption::of_actors(self.rate / 100.0 / 60.0, self.seed);
        match self.keep_learner {
            true => preemption,
            false => preemption.and_learner(Duration::from_secs_f64(experiment.learner.metrics_seconds)),
        }
    }

    fn print(&self, job: &Job, preemption: &Preemption, unrolls: &Unrolls) -> Result<()> {
        let lines = metrics::read(&job.metrics())?;
        let last = lines.last().context("the run has no line of metrics")?;
        let killed = preemption.learner_killed;
        let kills = json!({
            "figure": "preemption.kills", "value": preemption.actors_killed, "unit": "actors",
            "learner": u8::from(killed.is_some()), "actors": self.actors, "seed": self.seed,
            "percent_a_minute": if self.quiet { 0.0 } else { self.rate },
            "environment_steps": last.environment_steps, "minutes": last.seconds / 60.0,
        });
        println!("{kills}");
        if let Some(LearnerKilled { reached, resumed }) = killed {
            let restart = json!({
                "figure": "preemption.restart", "value": reached.saturating_sub(resumed), "unit": "environment steps",
                "reached": reached, "resumed": resumed,
            });
            println!("{restart}");
        }
        unrolls.print();
        Ok(())
    }
}

/// Prints how far this run's curve is from that of another one, and draws both. Returns the difference of their means over the
/// last third.
fn compare(run: &Path, other: &Path) -> Result<f64> {
    let sources = [run, other].map(|run| plot::Source::of(run.join("metrics.jsonl")));
    let quantity = plot::Quantity::RewardPerStep;
    let difference = plot::difference(&sources[0], &sources[1], quantity)?;
    let picture = run.join("compared.svg");
    plot::draw_runs(&sources, &[quantity], &picture)?;
    let value = difference.ours - difference.theirs;
    let curve = json!({
        "figure": "preemption.curve", "value": value, "unit": "reward per step / most",
        "ours": difference.ours, "theirs": difference.theirs, "largest": difference.largest,
        "largest_at": difference.largest_at, "environment_steps": difference.until, "picture": picture,
    });
    println!("{curve}");
    Ok(value)
}

/// Fails if the curves are further apart than that. The runs have the same budget, or they would have been refused.
fn judge(difference: f64, tolerance: f64) -> Result<()> {
    ensure!(
        difference.abs() <= tolerance,
        "the reward per step over the last third differs by {difference:.3} from that of the other run, and at most {tolerance} is \
         allowed"
    );
    Ok(())
}

/// Refuses a run to compare with that learnt something else. Seeds may differ.
fn refuse_another_experiment(ours: &Experiment, other: &Path) -> Result<()> {
    let path = other.join("experiment.toml");
    let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let theirs = Experiment::from_toml(&path.display().to_string(), &text)?;
    match ours.differences(&theirs)?.into_iter().find(|difference| difference.field != "seed") {
        None => Ok(()),
        Some(difference) => bail!(
            "{} has `{} = {}`, and this run has `{}`: their curves would differ anyway",
            other.display(),
            difference.field,
            difference.theirs,
            difference.ours
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(arguments: &[&str]) -> Options {
        Options::try_parse_from(arguments).unwrap()
    }

    #[test]
    fn the_budget_is_in_minutes_or_in_steps_and_what_the_user_sets_has_precedence() {
        let run = tempfile::tempdir().unwrap();
        let run = run.path().join("run").display().to_string();
        let budget = |arguments: &[&str]| {
            let Budget { minutes, environment_steps, .. } =
                options(&[arguments, &["--run", &run]].concat()).job().unwrap().experiment().budget;
            (minutes, environment_steps)
        };
        assert_eq!(budget(&[]), (20.0, 0));
        assert_eq!(budget(&["--environment-steps", "1500"]), (0.0, 1500));
        assert_eq!(budget(&["--set", "budget.minutes=1"]), (1.0, 0));
        assert!(Options::try_parse_from(["--minutes", "1", "--environment-steps", "1500"]).is_err());
    }

    #[test]
    fn a_rate_is_a_percentage_and_a_quiet_run_has_none() {
        for wrong in ["--rate=-1", "--rate=nan", "--rate=inf", "--rate=6001"] {
            assert!(Options::try_parse_from([wrong]).is_err(), "{wrong}");
        }
        assert!(Options::try_parse_from(["--quiet", "--rate", "5"]).is_err());
        assert_eq!(options(&["--rate", "0"]).rate, 0.0);
    }

    #[test]
    fn every_checkpoint_is_kept() {
        let run = tempfile::tempdir().unwrap();
        let run = run.path().join("run").display().to_string();
        let kept = |arguments: &[&str]| {
            let job = options(&[arguments, &["--run", &run]].concat()).job().unwrap();
            job.experiment().learner.checkpoints_kept
        };
        assert_eq!(kept(&[]), KEPT);
        assert_eq!(kept(&["--set", "learner.checkpoints_kept=3"]), KEPT);
    }

    #[test]
    fn a_tolerance_is_a_share_of_the_reward_and_needs_a_run_to_compare_with() {
        for wrong in ["--tolerance=-0.1", "--tolerance=nan", "--tolerance=1.1"] {
            assert!(Options::try_parse_from(["--compare", "runs/quiet", wrong]).is_err(), "{wrong}");
        }
        assert!(Options::try_parse_from(["--tolerance", "0.1"]).is_err());
        assert_eq!(options(&["--compare", "runs/quiet", "--tolerance", "0.1"]).tolerance, 0.1);
        assert_eq!(options(&["--compare", "runs/quiet"]).tolerance, 0.05);
    }

    #[test]
    fn a_curve_that_ends_away_from_the_other_one_fails() {
        let runs = tempfile::tempdir().unwrap();
        // In the first two thirds each curve is somewhere else. Over the last third both are flat.
        let write = |name: &str, start: f64, end: f64| {
            let run = runs.path().join(name);
            std::fs::create_dir_all(&run).unwrap();
            let line = |number: u32| {
                let reward = if number < 100 { start } else { end };
                json!({ "environment_steps": number * 1000, "reward_per_step": reward }).to_string()
            };
            std::fs::write(run.join("metrics.jsonl"), (0..300).map(line).collect::<Vec<_>>().join("\n")).unwrap();
            run
        };
        let quiet = write("quiet", 0.1, 0.6);
        for (end, passes) in [(0.6, true), (0.56, true), (0.64, true), (0.54, false), (0.66, false)] {
            let difference = compare(&write("preempted", 0.3, end), &quiet).unwrap();
            assert!((difference - (end - 0.6)).abs() < 1e-9, "{difference}");
            assert_eq!(judge(difference, 0.05).is_ok(), passes, "{end}");
        }
        // No number is no small difference.
        assert!(judge(f64::NAN, 0.05).is_err());
    }

    #[test]
    fn a_run_to_compare_with_may_differ_in_its_seed_only() {
        let other = tempfile::tempdir().unwrap();
        let ours = Experiment::default();
        let mut theirs = Experiment { seed: 7, ..Experiment::default() };
        let write = |theirs: &Experiment| {
            std::fs::write(other.path().join("experiment.toml"), theirs.to_toml().unwrap()).unwrap();
            refuse_another_experiment(&ours, other.path())
        };
        write(&theirs).unwrap();
        theirs.budget.environment_steps = 9;
        let error = write(&theirs).unwrap_err().to_string();
        assert!(error.contains("has `budget.environment_steps = 9`, and this run has `0`"), "{error}");
    }
}
