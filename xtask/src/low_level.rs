//! `cargo xtask low-level`: makes the built-in low level again, from nothing.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};
use comic_setup::Interrupt;

use crate::train::display::Display;
use crate::train::{self, Job, child, evaluation};
use crate::workspace;

/// The preset that learns it.
const PRESET: &str = "low-level";

#[derive(clap::Args)]
pub(crate) struct Options {
    /// Minutes to train, instead of the preset's budget
    #[arg(long)]
    minutes: Option<f64>,
    /// Override any field of the preset `low-level`, for instance --set seed=2
    #[arg(long = "set", value_name = "FIELD=VALUE")]
    overrides: Vec<String>,
    /// Directory of the run; one that has a run already is continued [default: runs/low-level]
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// The low level with its prior and its card [default: low_level.safetensors in the run's directory]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Trains and evaluates, takes the low level out, fits its prior, measures it, and writes it with its card.
pub(crate) fn run(options: Options) -> Result<()> {
    let directory = options.run.clone().unwrap_or_else(|| workspace::root().join("runs").join(PRESET));
    let made_by = options.describe();
    let resume = directory.join("checkpoints").is_dir();
    let job = Job::new(train::Options {
        preset: PRESET.to_owned(),
        clips: Vec::new(),
        overrides: options.overrides,
        actors: 2,
        run: Some(directory),
        port: None,
        minutes: options.minutes,
        episodes: None,
        no_evaluator: false,
        resume,
    })?;
    let out = options.out.unwrap_or_else(|| job.path().join("low_level.safetensors"));
    train::prepare()?;
    let interrupt = Interrupt::install()?;
    let mut display = Display::new(&job.experiment().budget);
    let outcome = job.train(&mut display, &interrupt);
    display.finish();
    outcome?;
    let go_on = || match interrupt.requested() {
        true => bail!("interrupted; the same command continues the run in {}", job.path().display()),
        false => Ok(()),
    };
    go_on()?;
    let evaluations = job.evaluate(&mut display, &interrupt)?;
    println!("{}", evaluation::table(&evaluations));
    let steps = Steps { run: job.path(), out: &out, made_by };
    let trained = evaluations.iter().find(|(policy, _)| policy == "trained").map(|(_, evaluation)| evaluation);
    let trained = trained.context("nothing was learned: the budget was used up before the first checkpoint")?;
    serde_json::to_writer(create(&steps.evaluation())?, trained).context("cannot write the evaluation")?;
    for (name, step, output) in steps.all()? {
        go_on()?;
        display.event(name, &[("command", workspace::describe(&step))]);
        let mut command = child::command(Path::new(step.get_program()));
        command.args(step.get_args());
        if let Some(path) = output {
            command.stdout(Stdio::from(create(&path)?));
        }
        workspace::run(&mut command).or_else(|error| go_on().and(Err(error)))?;
    }
    println!("\nwritten to {}", out.display());
    Ok(())
}

fn create(path: &Path) -> Result<File> {
    File::create(path).with_context(|| format!("cannot write {}", path.display()))
}

impl Options {
    /// The command as a person types it, without the places of files.
    fn describe(&self) -> String {
        let minutes = self.minutes.map(|minutes| format!(" --minutes {minutes}"));
        let overrides = self.overrides.iter().map(|setting| format!(" --set '{setting}'"));
        ["cargo xtask low-level".to_owned()].into_iter().chain(minutes).chain(overrides).collect()
    }
}

/// What follows training. Every file but the result is in the run's directory.
struct Steps<'a> {
    run: &'a Path,
    out: &'a Path,
    made_by: String,
}

/// A name, a command, and where its standard output goes if not to the terminal.
type Step = (&'static str, Command, Option<PathBuf>);

impl Steps<'_> {
    /// The evaluation of the trained policy alone.
    fn evaluation(&self) -> PathBuf {
        self.run.join("trained.json")
    }

    fn all(&self) -> Result<[Step; 5]> {
        let of = |program: &str, first: &[&str]| -> Result<Command> {
            let mut command = Command::new(workspace::program(program)?);
            command.args(first);
            Ok(command)
        };
        let file = |name: &str| self.run.join(name);
        let (bare, latents) = (file("without-prior.safetensors"), file("latents.safetensors"));
        let (fitted, assessment) = (file("with-prior.safetensors"), file("assessment.json"));

        let mut export = of("comic-learner", &["export", "--part", "low-level", "--checkpoint"])?;
        export.arg(self.run).arg("--out").arg(&bare);
        let mut encode = of("comic-actor", &["latents", "--checkpoint"])?;
        encode.arg(self.run).arg("--out").arg(&latents);
        let mut prior = of("comic-learner", &["prior", "--low-level"])?;
        prior.arg(&bare).arg("--latents").arg(&latents).arg("--out").arg(&fitted);
        let mut assess = of("comic-actor", &["assess", "--json", "--low-level"])?;
        assess.arg(&fitted);
        let mut card = of("comic-learner", &["low-level"])?;
        card.arg(&fitted).arg("--out").arg(self.out).args(["--made-by", &self.made_by]);
        card.arg("--evaluation").arg(self.evaluation()).arg("--assessment").arg(&assessment);
        Ok([
            ("taking the low level out", export, None),
            ("encoding", encode, None),
            ("fitting the prior", prior, None),
            ("assessing", assess, Some(assessment)),
            ("writing the card", card, None),
        ])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_in_the_card_makes_the_same_again() {
        let options =
            Options { minutes: Some(45.0), overrides: vec!["seed=2".into()], run: Some("a".into()), out: None };
        assert_eq!(options.describe(), "cargo xtask low-level --minutes 45 --set 'seed=2'");
    }

    #[test]
    fn every_step_reads_what_an_earlier_one_wrote() {
        let steps = Steps { run: Path::new("run"), out: Path::new("out.safetensors"), made_by: "again".into() };
        let mut written = vec![steps.run.to_owned(), steps.evaluation()];
        for (name, command, output) in steps.all().unwrap() {
            let words: Vec<_> = command.get_args().map(|word| word.to_string_lossy().into_owned()).collect();
            let of =
                |option: &str| words.iter().position(|word| word == option).map(|at| PathBuf::from(&words[at + 1]));
            for option in ["--checkpoint", "--low-level", "--latents", "--evaluation", "--assessment"] {
                let read = of(option);
                assert!(read.iter().all(|path| written.contains(path)), "{name}: {read:?} of {written:?}");
            }
            written.extend(of("--out").into_iter().chain(output));
        }
        assert_eq!(written.last().unwrap(), steps.out);
    }
}
