//! Learning curves as pictures: single runs over wall-clock time and over environment steps, or groups of runs as mean and
//! range over environment steps.

mod panel;
mod pool;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use plotters::prelude::*;

use crate::metrics::{self, Line};
use panel::{Series, panel};
use pool::pool;

/// Points of a smoothing window. The learner writes a line every few seconds.
const SMOOTHED_OVER: usize = 5;

/// A quantity that curves show.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Quantity {
    /// Return of an episode, with the acting policy's noise.
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

    fn label(self) -> &'static str {
        match self {
            Self::EpisodeReturn => "episode return (with noise)",
            Self::NormalisedReward => "normalised reward (with noise)",
            Self::RewardPerStep => "reward per step (with noise)",
            Self::HeadHeight => "height of the head, m (with noise)",
        }
    }
}

/// A file of metrics and the name of its curve.
pub(crate) struct Source {
    label: String,
    path: PathBuf,
    /// In joint training the task whose episodes are drawn; none draws all episodes.
    task: Option<String>,
}

impl Source {
    /// A run's metrics are named after its directory, other files after themselves.
    pub(crate) fn of(path: PathBuf) -> Self {
        let metrics = path.file_stem().is_some_and(|stem| stem == "metrics");
        let named = if metrics { path.parent().and_then(Path::file_name) } else { path.file_stem() };
        Self { label: named.unwrap_or(path.as_os_str()).to_string_lossy().into_owned(), path, task: None }
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
                Self { label: label.to_owned(), ..Self::of(path.into()) }
            }
            _ => Self::of(file.into()),
        };
        Self { task, ..source }
    }
}

/// A quantity's value at a moment of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Point {
    minutes: f64,
    /// Environment steps, millions.
    steps: f64,
    value: f64,
}

/// `cargo xtask plot`.
pub(crate) fn run(metrics: &[String], quantities: &[Quantity], out: &Path) -> Result<()> {
    let sources: Vec<Source> = metrics.iter().map(|argument| Source::parse(argument)).collect();
    draw_runs(&sources, quantities, out)?;
    eprintln!("drew {}", out.display());
    Ok(())
}

/// Draws a curve for each run, over wall-clock time and over environment steps; a row for each quantity.
pub(crate) fn draw_runs(sources: &[Source], quantities: &[Quantity], out: &Path) -> Result<()> {
    let rows = quantities.iter().map(|quantity| Ok((*quantity, over_both(sources, *quantity)?)));
    draw(&rows.collect::<Result<Vec<_>>>()?, out)
}

/// The curves of one quantity over wall-clock time, and over environment steps.
fn over_both(sources: &[Source], quantity: Quantity) -> Result<Vec<Panel>> {
    let curves = sources
        .iter()
        .map(|source| read(&source.path, source.task.as_deref(), quantity))
        .collect::<Result<Vec<_>>>()?;
    let series = |x: fn(&Point) -> f64| -> Vec<Series> {
        let line = |points: &Vec<Point>| points.iter().map(|point| (x(point), point.value)).collect();
        let named = sources.iter().zip(&curves);
        named.map(|(source, points)| Series::line(source.label.clone(), line(points))).collect()
    };
    Ok(vec![
        ("minutes of wall clock", series(|point| point.minutes)),
        ("million environment steps", series(|point| point.steps)),
    ])
}

/// Draws each group of runs as their mean over environment steps, with a band from the minimum to the maximum.
pub(crate) fn draw_groups(groups: &[(String, Vec<PathBuf>)], quantity: Quantity, out: &Path) -> Result<()> {
    let series = groups.iter().map(|(label, runs)| {
        let curves = runs.iter().map(|path| read(path, None, quantity)).collect::<Result<Vec<_>>>()?;
        Ok(pool(label.clone(), &curves))
    });
    draw(&[(quantity, vec![("million environment steps", series.collect::<Result<Vec<_>>>()?)])], out)
}

fn read(path: &Path, task: Option<&str>, quantity: Quantity) -> Result<Vec<Point>> {
    let mut points: Vec<Point> = Vec::new();
    for line in metrics::read(path)? {
        let of_task = match task {
            Some(task) => line.tasks.get(task),
            None => Some(&line),
        };
        if let Some(value) = of_task.and_then(|line| quantity.of(line)) {
            let steps = line.environment_steps as f64 / 1e6;
            // A killed run repeats the steps after its last checkpoint. The newer lines replace the older ones.
            points.truncate(points.partition_point(|point| point.steps < steps));
            points.push(Point { minutes: line.seconds / 60.0, steps, value });
        }
    }
    if points.is_empty() {
        let of_task = task.map_or_else(String::new, |task| format!(" of {task}"));
        bail!("{} has no finished episode{of_task} yet, or none with the {}", path.display(), quantity.label());
    }
    Ok(smooth(&points))
}

/// The mean of each point and the few before it.
fn smooth(points: &[Point]) -> Vec<Point> {
    let mean = |window: &[Point]| window.iter().map(|point| point.value).sum::<f64>() / window.len() as f64;
    let smoothed = points.iter().enumerate().map(|(index, point)| {
        let window = &points[(index + 1).saturating_sub(SMOOTHED_OVER)..=index];
        Point { value: mean(window), ..*point }
    });
    smoothed.collect()
}

/// The label of the x axis, and the series.
type Panel = (&'static str, Vec<Series>);

/// Draws a row of panels for each quantity.
fn draw(rows: &[(Quantity, Vec<Panel>)], out: &Path) -> Result<()> {
    let root = SVGBackend::new(out, (1000, 400 * rows.len() as u32)).into_drawing_area();
    let drawn = || -> Result<()> {
        root.fill(&WHITE).map_err(|error| anyhow!("{error}"))?;
        for (row, (quantity, panels)) in root.split_evenly((rows.len(), 1)).iter().zip(rows) {
            for (area, (x_label, series)) in row.split_evenly((1, panels.len())).iter().zip(panels) {
                panel(area, series, x_label, quantity.label())?;
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

    #[test]
    fn a_run_and_a_baseline_are_drawn_into_one_picture_with_both_axes_and_names() {
        let directory = tempfile::tempdir().unwrap();
        let run = metrics(directory.path(), "walk-1/metrics.jsonl", &[(1_000_000, 2.0), (2_000_000, 2.5)]);
        let baseline = directory.path().join("sb3.jsonl");
        std::fs::write(&baseline, "{\"seconds\": 30, \"env_steps\": 8030, \"episode_return\": 1.0}\n").unwrap();
        let out = directory.path().join("curve.svg");
        let arguments = [run.display().to_string(), format!("PPO={}", baseline.display())];
        super::run(&arguments, &[Quantity::EpisodeReturn], &out).unwrap();
        let picture = std::fs::read_to_string(out).unwrap();
        for text in ["walk-1", "PPO", "minutes of wall clock", "million environment steps"] {
            assert!(picture.contains(text), "{text} is missing");
        }
    }

    #[test]
    fn every_quantity_has_its_own_row_and_a_missing_one_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let (path, out) = (directory.path().join("metrics.jsonl"), directory.path().join("curve.svg"));
        std::fs::write(&path, "{\"environment_steps\":1000000,\"episode_return\":9.0,\"head_height\":1.2}\n").unwrap();
        let arguments = [path.display().to_string()];
        super::run(&arguments, &[Quantity::EpisodeReturn, Quantity::HeadHeight], &out).unwrap();
        let picture = std::fs::read_to_string(&out).unwrap();
        for text in ["episode return (with noise)", "height of the head, m (with noise)"] {
            assert_eq!(picture.matches(text).count(), 2, "{text}: over wall clock and over steps");
        }
        let error = super::run(&arguments, &[Quantity::NormalisedReward], &out).unwrap_err();
        assert!(error.to_string().contains("normalised reward"), "{error}");
    }

    #[test]
    fn groups_of_runs_are_drawn_as_lines_with_bands_and_names() {
        let directory = tempfile::tempdir().unwrap();
        let runs = [1.0, 2.0].map(|value| {
            metrics(directory.path(), &format!("{value}/metrics.jsonl"), &[(1, value), (1_000_000, value)])
        });
        let out = directory.path().join("curves.svg");
        draw_groups(&[("beta=0".into(), runs.to_vec())], Quantity::EpisodeReturn, &out).unwrap();
        let picture = std::fs::read_to_string(out).unwrap();
        for part in ["beta=0", "million environment steps", "<polygon"] {
            assert!(picture.contains(part), "{part} is missing");
        }
        assert!(!picture.contains("wall clock"));
    }

    #[test]
    fn a_path_with_an_equals_sign_that_exists_has_no_label() {
        let directory = tempfile::tempdir().unwrap();
        let run = metrics(directory.path(), "beta=1e-4,seed=2/metrics.jsonl", &[(1, 1.0)]);
        let source = Source::parse(&run.display().to_string());
        assert_eq!((source.label.as_str(), source.path), ("beta=1e-4,seed=2", run));
    }

    #[test]
    fn a_named_tasks_episodes_are_drawn() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("metrics.jsonl");
        let line = r#"{"environment_steps":1000000,"episode_return":9.0,"tasks":{"get-up":{"episode_return":2.0}}}"#;
        std::fs::write(&path, format!("{line}\n")).unwrap();
        let of = |argument: &str| {
            let Source { path, task, .. } = Source::parse(&argument.replace("FILE", &path.display().to_string()));
            read(&path, task.as_deref(), Quantity::EpisodeReturn).map(|points| (points[0].steps, points[0].value))
        };
        assert_eq!(of("FILE").unwrap(), (1.0, 9.0));
        assert_eq!(of("up=FILE#get-up").unwrap(), (1.0, 2.0));
        assert!(of("FILE#gaps").unwrap_err().to_string().contains("no finished episode of gaps yet"));
    }

    #[test]
    fn steps_repeated_after_a_crash_are_drawn_once() {
        let directory = tempfile::tempdir().unwrap();
        let lines = [(1_000_000, 1.0), (2_000_000, 7.0), (3_000_000, 7.0), (2_000_000, 1.0), (4_000_000, 1.0)];
        let points = read(&metrics(directory.path(), "metrics.jsonl", &lines), None, Quantity::EpisodeReturn).unwrap();
        assert_eq!(
            points.iter().map(|point| (point.steps, point.value)).collect::<Vec<_>>(),
            [(1.0, 1.0), (2.0, 1.0), (4.0, 1.0)]
        );
    }

    #[test]
    fn smoothing_keeps_a_constant_and_uses_no_later_points() {
        let points = |values: &[f64]| -> Vec<Point> {
            values.iter().map(|value| Point { minutes: 0.0, steps: 0.0, value: *value }).collect()
        };
        assert_eq!(smooth(&points(&[2.0; 9])), points(&[2.0; 9]));
        assert_eq!(smooth(&points(&[0.0, 0.0, 3.0])), points(&[0.0, 0.0, 1.0]));
    }
}
