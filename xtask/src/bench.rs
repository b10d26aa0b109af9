//! `cargo xtask bench`: the figures of the README, one JSON line each.

use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};
use comic_experiment::LowLevelName;
use serde::{Deserialize, Serialize};

use crate::{python, setup, workspace};

#[derive(clap::Args)]
pub(crate) struct Options {
    /// Which side
    side: Side,
    /// libtorch's threads in the learner's update, ours and PyTorch's
    #[arg(long, default_value_t = 2)]
    threads: u16,
    /// Arguments for the program's own bench
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    arguments: Vec<String>,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Side {
    /// Environments, policies, threads, resets, the wire
    Actor,
    /// The update, against its matrix products and against PyTorch
    Learner,
    /// Images of what the humanoid sees
    Vision,
    /// Unrolls into batches, from 32 connections and from 1000
    Ingest,
    /// Parameters to 1000 connections, and to some that stop reading
    Publish,
    /// 4000 actors for 20 minutes
    Swarm,
}

/// One figure; ratio = value / floor.
#[derive(Clone, Debug, Deserialize, Serialize, PartialEq)]
struct Figure {
    figure: String,
    value: f64,
    unit: String,
    floor: f64,
    ratio: f64,
    /// What else the program says of it.
    #[serde(flatten)]
    rest: serde_json::Map<String, serde_json::Value>,
}

/// Rounds in which our update and PyTorch's take turns.
const ROUNDS: usize = 3;

/// Low levels beside the MLP, which has figures for everything.
fn others() -> impl Iterator<Item = &'static str> {
    LowLevelName::ALL.into_iter().filter(|name| *name != LowLevelName::Mlp).map(LowLevelName::name)
}

/// Builds and measures.
pub(crate) fn run(options: &Options) -> Result<()> {
    setup::run(&setup::Options::default())?;
    workspace::build()?;
    match options.side {
        Side::Actor => {
            let bench = |arguments: &[String]| {
                show(&figures(Command::new(workspace::program("comic-actor")?).arg("bench").args(arguments))?)
            };
            bench(&options.arguments)?;
            let mut others = others().filter(|_| options.arguments.is_empty());
            others.try_for_each(|name| bench(&["policy", "--low-level", name].map(String::from)))
        }
        Side::Vision => {
            let mut bench = Command::new(workspace::program("comic-actor")?);
            show(&figures(bench.args(["bench", "vision"]).args(&options.arguments))?)
        }
        Side::Learner => {
            let arguments = &options.arguments;
            learner(options.threads, arguments)?;
            if chooses(arguments) {
                return Ok(());
            }
            let others = others().map(|name| vec!["--low-level".to_owned(), name.to_owned()]);
            let mut ways = others.chain([vec!["--joint".to_owned()]]);
            ways.try_for_each(|way| learner(options.threads, &[way, arguments.clone()].concat()))
        }
        Side::Ingest => load("ingest", &options.arguments),
        Side::Publish => load("publish", &options.arguments),
        Side::Swarm => load("swarm", &options.arguments),
    }
}

/// The service under actors that are not real; each figure is printed when it is there.
fn load(figure: &str, arguments: &[String]) -> Result<()> {
    let mut load = Command::new(workspace::program("comic-learner")?);
    // Thousands of actors come and go: what the log says of each is no news.
    load.args(["load", figure]).args(arguments).env("RUST_LOG", "warn");
    workspace::run(&mut load)
}

/// Whether these choose something else to measure than the MLP on one task.
fn chooses(arguments: &[String]) -> bool {
    arguments.iter().any(|argument| argument.starts_with("--low-level") || argument == "--joint")
}

/// Our update and the same update in Python PyTorch, by turns, so that a busy moment of the machine meets both.
fn learner(threads: u16, arguments: &[String]) -> Result<()> {
    // The other script knows the MLP alone.
    let compares = !chooses(arguments);
    let mut ours = Vec::new();
    let mut theirs = Vec::new();
    for _ in 0..ROUNDS {
        let mut bench = Command::new(workspace::program("comic-learner")?);
        ours.push(figures(bench.args(["bench", "--threads", &threads.to_string()]).args(arguments))?);
        if compares {
            theirs.push(pytorch(threads)?);
        }
    }
    let Some(first) = ours.first() else { return Ok(()) };
    let mut lines = Vec::new();
    for (index, figure) in first.iter().enumerate() {
        let of_rounds =
            |part: fn(&Figure) -> f64| median(ours.iter().filter_map(|round| round.get(index)).map(part).collect());
        let (value, floor) = (of_rounds(|figure| figure.value), of_rounds(|figure| figure.floor));
        let mut line = Figure { value, floor, ratio: value / floor, ..figure.clone() };
        for (name, number) in &mut line.rest {
            let rounds = ours.iter().filter_map(|round| round.get(index)?.rest.get(name)?.as_f64()).collect();
            *number = median(rounds).into();
        }
        lines.push(line);
    }
    if compares {
        let update = lines.iter().find(|figure| figure.figure == "learner.update");
        let update = update.context("comic-learner bench printed no learner.update")?.clone();
        let floor = median(theirs);
        let rest = serde_json::Map::new();
        lines.push(Figure { figure: "learner.pytorch".into(), floor, ratio: update.value / floor, rest, ..update });
    }
    show(&lines)
}

/// Milliseconds of the update written plainly in Python PyTorch, same shapes and threads.
fn pytorch(threads: u16) -> Result<f64> {
    #[derive(Deserialize)]
    struct Answer {
        milliseconds: f64,
    }
    let mut command = python::script_command("torch_vmpo_update.py", "requirements-torch.txt")?;
    let lines = output(command.args(["--threads", &threads.to_string()]))?;
    let answer = lines.lines().last().context("torch_vmpo_update.py printed nothing")?;
    let answer: Answer = serde_json::from_str(answer).with_context(|| format!("unreadable answer: {answer}"))?;
    Ok(answer.milliseconds)
}

fn figures(command: &mut Command) -> Result<Vec<Figure>> {
    let text = output(command)?;
    let lines = text.lines().filter(|line| line.starts_with('{'));
    lines.map(|line| serde_json::from_str(line).with_context(|| format!("unreadable figure: {line}"))).collect()
}

fn output(command: &mut Command) -> Result<String> {
    let output = command.stdin(Stdio::null()).stderr(Stdio::inherit()).output();
    let output = output.with_context(|| format!("cannot start {}", workspace::describe(command)))?;
    if !output.status.success() {
        bail!("{} ended with {}", workspace::describe(command), output.status);
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

fn show(figures: &[Figure]) -> Result<()> {
    for figure in figures {
        println!("{}", serde_json::to_string(figure)?);
    }
    Ok(())
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    match values.len() {
        0 => f64::NAN,
        length if length % 2 == 1 => values[length / 2],
        length => (values[length / 2 - 1] + values[length / 2]) / 2.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_stands_in_the_middle_whatever_the_order() {
        assert_eq!(median(vec![3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(vec![4.0, 1.0, 2.0, 3.0]), 2.5);
    }
}
