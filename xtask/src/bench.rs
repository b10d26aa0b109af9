//! `cargo xtask bench`: the figures of docs/benchmarks.md, one JSON line each.

mod preemption;

use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};
use comic_experiment::LowLevelName;
use serde::{Deserialize, Serialize};

use crate::{python, setup, wheel, workspace};

#[derive(clap::Args)]
pub(crate) struct Options {
    /// What is measured
    side: Side,
    /// libtorch's threads in the learner's update and in PyTorch's
    #[arg(long, default_value_t = 2)]
    threads: u16,
    /// Arguments for comic-bench-actor, comic-bench-learner or the run that is preempted; `-- --help` lists them
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    arguments: Vec<String>,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Side {
    /// Environments, policies, threads, resets, the path of an unroll
    Actor,
    /// The update, against its matrix products and against PyTorch
    Learner,
    /// The update of several learners together, against the same without exchange
    Ranks,
    /// The replay's table, against bare copies
    Replay,
    /// Tracking of 2 to 836 clips: a step, memory, loading
    Clips,
    /// Images of the humanoid's camera
    Vision,
    /// Unrolls into batches, from 32 connections and from 1000
    Ingest,
    /// Parameters to 1000 connections, and to some that stop reading
    Publish,
    /// 4000 actors for 20 minutes
    Swarm,
    /// Environments stepped from Python, and dm_control's own loop, against `actor.env`
    Python,
    /// A run whose processes are killed and replaced for 20 minutes: its accounting, and its curve
    Preemption,
}

/// One figure; ratio = value / floor.
#[derive(Clone, Debug, Deserialize, Serialize, PartialEq)]
struct Figure {
    figure: String,
    value: f64,
    unit: String,
    floor: f64,
    ratio: f64,
    /// The other members of the program's line.
    #[serde(flatten)]
    rest: serde_json::Map<String, serde_json::Value>,
}

/// Rounds in which our update and PyTorch's take turns.
const ROUNDS: usize = 3;

/// All low levels but the MLP, whose figures bear no name.
fn other_low_levels() -> impl Iterator<Item = &'static str> {
    LowLevelName::ALL.into_iter().filter(|name| *name != LowLevelName::Mlp).map(LowLevelName::name)
}

/// Builds and measures.
pub(crate) fn run(options: &Options) -> Result<()> {
    // A run that is preempted needs the shipped programs, and builds them.
    if options.side != Side::Preemption {
        setup::run(&setup::Options::default())?;
        workspace::build(&workspace::BENCHMARKS)?;
    }
    let arguments = &options.arguments;
    match options.side {
        Side::Actor => {
            actor(arguments)?;
            let mut others = other_low_levels().filter(|_| arguments.is_empty());
            others.try_for_each(|name| actor(&["policy", "--low-level", name].map(String::from)))
        }
        Side::Clips => actor(&[&["clips".to_owned()], &arguments[..]].concat()),
        Side::Vision => actor(&[&["vision".to_owned()], &arguments[..]].concat()),
        Side::Learner => {
            learner(options.threads, arguments)?;
            if chooses_network(arguments) {
                return Ok(());
            }
            let others = other_low_levels().map(|name| vec!["--low-level".to_owned(), name.to_owned()]);
            let mut networks = others.chain(["--joint", "--svg0"].map(|option| vec![option.to_owned()]));
            networks.try_for_each(|network| learner(options.threads, &[network, arguments.clone()].concat()))
        }
        Side::Ranks => printing("ranks", arguments),
        Side::Replay => printing("replay", arguments),
        Side::Ingest => printing("ingest", arguments),
        Side::Publish => printing("publish", arguments),
        Side::Swarm => printing("swarm", arguments),
        Side::Python => python_environments(arguments),
        Side::Preemption => preemption::run(arguments),
    }
}

/// Environments stepped from Python, and a thread of the actor's. They take turns.
fn python_environments(arguments: &[String]) -> Result<()> {
    #[derive(Deserialize)]
    struct Measured {
        figure: String,
        value: f64,
        unit: String,
    }
    python::prepare_tests()?;
    python::install_for_tests(&wheel::build()?)?;
    let mut rounds = Vec::new();
    for _ in 0..ROUNDS {
        let mut bench = Command::new(workspace::program("comic-bench-actor")?);
        let bare = figures(bench.args(["--seconds", "5", "env"]))?;
        let floor = bare.first().context("comic-bench-actor printed no figure")?.value;
        let mut script = python::script_command("python_environments.py", python::TESTS)?;
        let text = output(script.args(arguments))?;
        let against_actor = |line: &str| -> Result<Figure> {
            let Measured { figure, value, unit } =
                serde_json::from_str(line).with_context(|| format!("unreadable figure: {line}"))?;
            Ok(Figure { figure, value, unit, floor, ratio: value / floor, rest: serde_json::Map::new() })
        };
        rounds.push(text.lines().map(against_actor).collect::<Result<Vec<_>>>()?);
    }
    medians(&rounds).iter().try_for_each(|figure| {
        println!("{}", serde_json::to_string(figure)?);
        Ok(())
    })
}

fn actor(arguments: &[String]) -> Result<()> {
    workspace::run(Command::new(workspace::program("comic-bench-actor")?).args(arguments))
}

/// A measurement of the learner's program, which prints each figure when it is measured.
fn printing(figure: &str, arguments: &[String]) -> Result<()> {
    workspace::run(Command::new(workspace::program("comic-bench-learner")?).arg(figure).args(arguments))
}

/// The options that choose another network than the MLP on one task.
const NETWORKS: [&str; 4] = ["--low-level", "--joint", "--svg0", "--preset"];

/// Whether the arguments choose another network than the MLP on one task.
fn chooses_network(arguments: &[String]) -> bool {
    arguments.iter().any(|argument| NETWORKS.iter().any(|option| argument.starts_with(option)))
}

/// An update that is also written in Python PyTorch.
struct Written {
    /// Our figure.
    figure: &'static str,
    /// The figure of the comparison.
    against: &'static str,
    script: &'static str,
}

const VMPO: Written = Written { figure: "learner.update", against: "learner.pytorch", script: "torch_vmpo_update.py" };
const SVG0: Written =
    Written { figure: "learner.svg0", against: "learner.svg0.pytorch", script: "torch_svg0_update.py" };

/// The update that the arguments choose, if it is written in PyTorch, too.
fn written(arguments: &[String]) -> Option<Written> {
    if !chooses_network(arguments) {
        return Some(VMPO);
    }
    arguments.iter().any(|argument| argument == "--svg0").then_some(SVG0)
}

/// Our update and the same update in Python PyTorch. They take turns, so that other programs slow down both.
fn learner(threads: u16, arguments: &[String]) -> Result<()> {
    let written = written(arguments);
    let cores = std::thread::available_parallelism().context("the number of cores is not known")?;
    let mut ours = Vec::new();
    let mut theirs = Vec::new();
    for _ in 0..ROUNDS {
        let mut bench = Command::new(workspace::program("comic-bench-learner")?);
        bench.args(["update", "--threads", &threads.to_string()]).args(arguments);
        if written.is_some() && !arguments.iter().any(|argument| argument.starts_with("--beside")) {
            bench.args(["--beside", &cores.to_string()]);
        }
        ours.push(figures(&mut bench)?);
        if let Some(Written { script, .. }) = written {
            theirs.push(pytorch(script, threads)?);
        }
    }
    let mut lines = medians(&ours);
    if let Some(Written { figure, against, .. }) = written {
        let update = lines.iter().find(|line| line.figure == figure);
        let update = update.with_context(|| format!("comic-bench-learner printed no {figure}"))?.clone();
        let floor = median(theirs);
        let rest = serde_json::Map::new();
        lines.push(Figure { figure: against.into(), floor, ratio: update.value / floor, rest, ..update });
    }
    for figure in lines {
        println!("{}", serde_json::to_string(&figure)?);
    }
    Ok(())
}

/// The median of `values`, NaN where there are none.
fn median(values: Vec<f64>) -> f64 {
    comic_experiment::statistics::median(values).unwrap_or(f64::NAN)
}

/// The figures of the first round, with the median of every number over all rounds.
fn medians(rounds: &[Vec<Figure>]) -> Vec<Figure> {
    let Some(first) = rounds.first() else { return Vec::new() };
    let mut lines = Vec::new();
    for (index, figure) in first.iter().enumerate() {
        let same = || rounds.iter().filter_map(move |round| round.get(index));
        let (value, floor) =
            (median(same().map(|figure| figure.value).collect()), median(same().map(|figure| figure.floor).collect()));
        let mut line = Figure { value, floor, ratio: value / floor, ..figure.clone() };
        for (name, member) in line.rest.iter_mut().filter(|(_, member)| member.is_number()) {
            *member = median(same().filter_map(|figure| figure.rest.get(name)?.as_f64()).collect()).into();
        }
        lines.push(line);
    }
    lines
}

/// Milliseconds of the update in a script in Python PyTorch, with the same shapes and threads.
fn pytorch(script: &str, threads: u16) -> Result<f64> {
    #[derive(Deserialize)]
    struct Answer {
        milliseconds: f64,
    }
    let mut command = python::script_command(script, "requirements-torch.txt")?;
    let lines = output(command.args(["--threads", &threads.to_string()]))?;
    let answer = lines.lines().last().with_context(|| format!("{script} printed nothing"))?;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_of_a_figure_is_the_median_of_its_rounds() {
        let figure = |value: f64, copy: f64| -> Figure {
            let line = serde_json::json!({
                "figure": "f", "value": value, "unit": "ms", "floor": 1.0, "ratio": value, "copy": copy, "device": "cpu"
            });
            serde_json::from_value(line).unwrap()
        };
        let found = medians(&[vec![figure(5.0, 2.0)], vec![figure(1.0, 9.0)], vec![figure(4.0, 3.0)]]);
        assert_eq!(found, [Figure { value: 4.0, ratio: 4.0, ..figure(4.0, 3.0) }]);
    }
}
