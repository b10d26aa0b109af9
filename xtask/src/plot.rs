//! Learning curves as pictures: single runs over wall-clock time and over environment steps, or groups of runs as mean and
//! bootstrap interval. A run's evaluations without noise are drawn beside its training.

mod bootstrap;
mod curve;
mod difference;
mod heat_map;
mod panel;
mod pool;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail, ensure};
use plotters::prelude::*;

use crate::evaluations::{self, ClipEvaluation};
use crate::metrics::Line;
use panel::{Kind, Series, panel};
use pool::pool;

pub(crate) use curve::Axis;
pub(crate) use difference::difference;
pub(crate) use heat_map::draw as draw_clips;

/// Both axes of a picture.
const BOTH: [Axis; 2] = [Axis::WallClock, Axis::EnvironmentSteps];

/// A quantity that curves show.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Quantity {
    /// Return of an episode.
    EpisodeReturn,
    /// Return / (the largest reward of a step × the steps that were left).
    NormalisedReward,
    /// Reward per survived step / the largest reward of a step.
    RewardPerStep,
    /// Mean height of the head, m.
    HeadHeight,
}

impl Quantity {
    fn of(self, line: &Line) -> Option<f64> {
        match self {
            Self::EpisodeReturn => line.episode_return,
            Self::NormalisedReward => line.normalised_reward,
            Self::RewardPerStep => line.reward_per_step,
            Self::HeadHeight => line.head_height,
        }
    }

    fn of_evaluation(self, means: &ClipEvaluation) -> Option<f64> {
        match self {
            Self::EpisodeReturn => Some(means.return_mean),
            Self::NormalisedReward => Some(means.normalised_reward),
            Self::RewardPerStep => Some(means.reward_per_step),
            Self::HeadHeight => means.head_height,
        }
    }

    fn label(self) -> &'static str {
        match self {
            Self::EpisodeReturn => "episode return",
            Self::NormalisedReward => "normalised reward",
            Self::RewardPerStep => "reward per step",
            Self::HeadHeight => "height of the head, m",
        }
    }
}

/// A file of metrics and the name of its curve.
pub(crate) struct Source {
    /// The name, if one was given.
    label: Option<String>,
    path: PathBuf,
    /// In joint training the task whose episodes are drawn; none draws all episodes.
    task: Option<String>,
}

impl Source {
    /// All episodes of the file.
    pub(crate) fn of(path: PathBuf) -> Self {
        Self { label: None, path, task: None }
    }

    /// Parses `FILE` or `LABEL=FILE`, either with `#TASK` after it. An existing file has no label, since the names of a
    /// sweep's runs contain `=`.
    fn parse(argument: &str) -> Self {
        let (file, task) = match argument.rsplit_once('#') {
            Some((file, task)) if !Path::new(argument).exists() => (file, Some(task.to_owned())),
            _ => (argument, None),
        };
        let source = match file.split_once('=') {
            Some((label, path)) if !Path::new(file).exists() => {
                Self { label: Some(label.to_owned()), ..Self::of(path.into()) }
            }
            _ => Self::of(file.into()),
        };
        Self { task, ..source }
    }

    /// Whether this is a run's file of metrics, and not one of another program.
    fn is_run(&self) -> bool {
        self.path.file_stem().is_some_and(|stem| stem == "metrics")
    }

    /// The curve's name. Without a label a run has the name of its directory, and another file its own.
    fn name(&self) -> String {
        let named = if self.is_run() { self.path.parent().and_then(Path::file_name) } else { self.path.file_stem() };
        let named = || named.unwrap_or(self.path.as_os_str()).to_string_lossy().into_owned();
        self.label.clone().unwrap_or_else(named)
    }

    /// The path of the run's evaluations, which need not exist.
    fn evaluations(&self) -> Option<PathBuf> {
        self.is_run().then(|| self.path.with_file_name(evaluations::FILE))
    }
}

/// `cargo xtask plot`; with `seeds` the files that have the same label are drawn as one curve.
pub(crate) fn run(metrics: &[String], quantities: &[Quantity], seeds: bool, out: &Path) -> Result<()> {
    let sources: Vec<Source> = metrics.iter().map(|argument| Source::parse(argument)).collect();
    if seeds {
        draw_groups(&by_label(sources), quantities, &BOTH, out)?;
    } else {
        draw_runs(&sources, quantities, out)?;
    }
    eprintln!("drew {}", out.display());
    Ok(())
}

/// `cargo xtask plot --clips`: a heat map of the clips of one run.
pub(crate) fn clips(metrics: &[String], out: &Path) -> Result<()> {
    let [run] = metrics else { bail!("--clips draws one run, not {}", metrics.len()) };
    let evaluations = Source::parse(run).evaluations();
    let evaluations = evaluations.ok_or_else(|| anyhow!("{run}: give the run's metrics.jsonl"))?;
    ensure!(draw_clips(&evaluations, out)?, "{}: has no evaluation of two clips or more", evaluations.display());
    eprintln!("drew {}", out.display());
    Ok(())
}

/// The labels in their first order, each with its files. All files without a label are one group.
fn by_label(sources: Vec<Source>) -> Vec<(String, Vec<Source>)> {
    let mut groups: Vec<(String, Vec<Source>)> = Vec::new();
    for source in sources {
        let label = source.label.clone().unwrap_or_else(|| "all".to_owned());
        match groups.iter_mut().find(|(known, _)| *known == label) {
            Some((_, group)) => group.push(source),
            None => groups.push((label, vec![source])),
        }
    }
    groups
}

/// Draws each run over wall-clock time and over environment steps; a row for each quantity.
pub(crate) fn draw_runs(sources: &[Source], quantities: &[Quantity], out: &Path) -> Result<()> {
    draw(quantities, &BOTH, |quantity, axis| single(sources, quantity, axis), out)
}

/// The curves of one quantity, for each run its training and its evaluation.
fn single(sources: &[Source], quantity: Quantity, axis: Axis) -> Result<Vec<Series>> {
    let mut series = Vec::new();
    for (colour, source) in sources.iter().enumerate() {
        let training = curve::training(source, quantity)?;
        let evaluated = curve::evaluated(source, quantity)?;
        for (kind, points) in [(Kind::Training, training), (Kind::Evaluation, evaluated)] {
            if !points.is_empty() {
                let line = points.iter().map(|point| (point.on(axis), point.value));
                series.push(Series::new(&source.name(), kind, colour).with_line(line));
            }
        }
    }
    Ok(series)
}

/// Draws each group of runs as their mean, with the 95 % bootstrap interval of the mean as a band; a row for each quantity.
pub(crate) fn draw_groups(
    groups: &[(String, Vec<Source>)],
    quantities: &[Quantity],
    axes: &[Axis],
    out: &Path,
) -> Result<()> {
    draw(quantities, axes, |quantity, axis| pooled(groups, quantity, axis), out)
}

/// The curves of one quantity, for each group its training and its evaluation.
fn pooled(groups: &[(String, Vec<Source>)], quantity: Quantity, axis: Axis) -> Result<Vec<Series>> {
    let mut series = Vec::new();
    for (colour, (name, sources)) in groups.iter().enumerate() {
        let training = sources.iter().map(|source| curve::training(source, quantity)).collect::<Result<Vec<_>>>()?;
        let evaluated = sources.iter().map(|source| curve::evaluated(source, quantity)).collect::<Result<Vec<_>>>()?;
        series.push(pool(Series::new(name, Kind::Training, colour), &training, axis));
        // The mean over a part of the runs could not be compared with that of training.
        if !evaluated.is_empty() && evaluated.iter().all(|points| !points.is_empty()) {
            series.push(pool(Series::new(name, Kind::Evaluation, colour), &evaluated, axis));
        }
    }
    Ok(series)
}

/// Draws a row of panels for each quantity, with a panel for each axis.
fn draw(
    quantities: &[Quantity],
    axes: &[Axis],
    series: impl Fn(Quantity, Axis) -> Result<Vec<Series>>,
    out: &Path,
) -> Result<()> {
    let row = |quantity: &Quantity| axes.iter().map(|axis| series(*quantity, *axis)).collect::<Result<Vec<_>>>();
    let rows = quantities.iter().map(row).collect::<Result<Vec<_>>>()?;
    let root = SVGBackend::new(out, (1000, 400 * quantities.len() as u32)).into_drawing_area();
    let drawn = || -> Result<()> {
        root.fill(&WHITE).map_err(|error| anyhow!("{error}"))?;
        for ((area, quantity), panels) in root.split_evenly((quantities.len(), 1)).iter().zip(quantities).zip(&rows) {
            for ((area, axis), series) in area.split_evenly((1, axes.len())).iter().zip(axes).zip(panels) {
                panel(area, series, axis.label(), quantity.label())?;
            }
        }
        root.present().map_err(|error| anyhow!("{error}"))
    };
    drawn().with_context(|| format!("cannot draw {}", out.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file with lines of environment steps and returns, in a directory of its own.
    fn metrics(directory: &Path, name: &str, lines: &[(u64, f64)]) -> PathBuf {
        let path = directory.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let line = |(steps, value): &(u64, f64)| {
            format!("{{\"seconds\":{steps},\"environment_steps\":{steps},\"episode_return\":{value}}}\n")
        };
        std::fs::write(&path, lines.iter().map(line).collect::<String>()).unwrap();
        path
    }

    /// Adds evaluations to the run with these metrics.
    fn evaluate(metrics: &Path, lines: &[(u64, f64)]) {
        let line = |(steps, reward): &(u64, f64)| evaluations::example(*steps, &[("walk", *reward)]);
        let text: String = lines.iter().map(line).collect();
        std::fs::write(metrics.with_file_name(evaluations::FILE), text).unwrap();
    }

    #[test]
    fn a_run_and_a_baseline_are_drawn_into_one_picture_with_both_axes_and_names() {
        let directory = tempfile::tempdir().unwrap();
        let run = metrics(directory.path(), "walk-1/metrics.jsonl", &[(1_000_000, 2.0), (2_000_000, 2.5)]);
        let baseline = directory.path().join("sb3.jsonl");
        std::fs::write(&baseline, "{\"seconds\": 30, \"env_steps\": 8030, \"episode_return\": 1.0}\n").unwrap();
        let out = directory.path().join("curve.svg");
        let arguments = [run.display().to_string(), format!("PPO={}", baseline.display())];
        super::run(&arguments, &[Quantity::EpisodeReturn], false, &out).unwrap();
        let picture = std::fs::read_to_string(out).unwrap();
        for text in ["walk-1 (with noise)", "PPO (with noise)", "minutes of wall clock", "million environment steps"] {
            assert!(picture.contains(text), "{text} is missing");
        }
        assert!(!picture.contains("without noise"));
    }

    #[test]
    fn evaluations_are_drawn_beside_their_runs_training() {
        let directory = tempfile::tempdir().unwrap();
        let run = metrics(directory.path(), "walk-1/metrics.jsonl", &[(1_000_000, 2.0), (2_000_000, 2.5)]);
        evaluate(&run, &[(1_000_000, 0.25), (2_000_000, 0.5)]);
        let out = directory.path().join("curve.svg");
        draw_runs(&[Source::of(run)], &[Quantity::EpisodeReturn], &out).unwrap();
        let picture = std::fs::read_to_string(out).unwrap();
        for text in ["walk-1 (with noise)", "walk-1 (without noise)"] {
            assert_eq!(picture.matches(text).count(), 2, "{text}: over wall clock and over steps");
        }
        assert_eq!(picture.matches("<circle").count(), 4, "every evaluation has a mark");
    }

    #[test]
    fn every_quantity_has_its_own_row_and_a_missing_one_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let (path, out) = (directory.path().join("metrics.jsonl"), directory.path().join("curve.svg"));
        std::fs::write(&path, "{\"environment_steps\":1000000,\"episode_return\":9.0,\"head_height\":1.2}\n").unwrap();
        let arguments = [path.display().to_string()];
        super::run(&arguments, &[Quantity::EpisodeReturn, Quantity::HeadHeight], false, &out).unwrap();
        let picture = std::fs::read_to_string(&out).unwrap();
        for text in ["episode return", "height of the head, m"] {
            assert_eq!(picture.matches(text).count(), 2, "{text}: over wall clock and over steps");
        }
        let error = super::run(&arguments, &[Quantity::NormalisedReward], false, &out).unwrap_err();
        assert!(error.to_string().contains("normalised reward"), "{error}");
    }

    #[test]
    fn groups_of_runs_are_drawn_as_lines_with_bands_and_names() {
        let directory = tempfile::tempdir().unwrap();
        let runs = [1.0, 2.0].map(|value| {
            metrics(directory.path(), &format!("{value}/metrics.jsonl"), &[(1, value), (1_000_000, value)])
        });
        let out = directory.path().join("curves.svg");
        let draw = || {
            let sources = runs.iter().cloned().map(Source::of).collect();
            draw_groups(&[("beta=0".into(), sources)], &[Quantity::EpisodeReturn], &[Axis::EnvironmentSteps], &out)
                .unwrap();
            std::fs::read_to_string(&out).unwrap()
        };
        let picture = draw();
        for part in ["beta=0 (with noise)", "million environment steps", "<polygon"] {
            assert!(picture.contains(part), "{part} is missing");
        }
        assert!(!picture.contains("wall clock"));
        evaluate(&runs[0], &[(1, 0.25), (1_000_000, 0.5)]);
        assert!(!draw().contains("without noise"), "one of two runs was not evaluated");
        evaluate(&runs[1], &[(1, 0.25), (1_000_000, 0.75)]);
        assert!(draw().contains("beta=0 (without noise)"));
    }

    #[test]
    fn files_with_the_same_label_are_one_group() {
        let sources = ["mlp=a.jsonl", "b.jsonl", "lstm=c.jsonl", "mlp=d.jsonl", "e.jsonl"].map(Source::parse);
        let groups = by_label(sources.into());
        let names = |group: &[Source]| group.iter().map(|source| source.path.display().to_string()).collect::<String>();
        let groups: Vec<_> = groups.iter().map(|(label, group)| (label.as_str(), names(group))).collect();
        let expected = [("mlp", "a.jsonld.jsonl"), ("all", "b.jsonle.jsonl"), ("lstm", "c.jsonl")];
        assert_eq!(groups, expected.map(|(label, files)| (label, files.to_owned())));
    }

    #[test]
    fn a_path_with_an_equals_sign_that_exists_has_no_label() {
        let directory = tempfile::tempdir().unwrap();
        let run = metrics(directory.path(), "beta=1e-4,seed=2/metrics.jsonl", &[(1, 1.0)]);
        let source = Source::parse(&run.display().to_string());
        assert_eq!((source.name().as_str(), source.path), ("beta=1e-4,seed=2", run));
    }
}
