//! Curves of runs as one picture: over wall-clock time and over environment steps.

use std::ops::Range;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use plotters::coord::Shift;
use plotters::prelude::*;

use crate::train::metrics::Line;

/// Points a window of smoothing is made of; lines come every few seconds and episodes are short and many.
const SMOOTHED_OVER: usize = 5;

/// What the curves show.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Quantity {
    /// Return of an episode, with the acting policy's noise; baselines have it too.
    EpisodeReturn,
    /// Return / (the most a step pays × the steps that were left).
    NormalisedReward,
    /// Reward per survived step.
    RewardPerStep,
}

impl Quantity {
    fn of(self, line: &Line) -> Option<f64> {
        match self {
            Self::EpisodeReturn => line.episode_return,
            Self::NormalisedReward => line.normalised_reward,
            Self::RewardPerStep => line.reward_per_step,
        }
    }

    fn label(self) -> &'static str {
        match self {
            Self::EpisodeReturn => "episode return (with noise)",
            Self::NormalisedReward => "normalised reward (with noise)",
            Self::RewardPerStep => "reward per step (with noise)",
        }
    }
}

/// One run's curve: (minutes, million environment steps, value).
struct Curve {
    label: String,
    points: Vec<(f64, f64, f64)>,
}

/// Draws the runs whose metrics are named by `FILE` or `LABEL=FILE` into `out`.
pub(crate) fn run(metrics: &[String], quantity: Quantity, out: &Path) -> Result<()> {
    let curves: Vec<Curve> = metrics.iter().map(|argument| read(argument, quantity)).collect::<Result<_>>()?;
    let root = SVGBackend::new(out, (1000, 400)).into_drawing_area();
    draw(&root, &curves, quantity)
        .and_then(|()| root.present().map_err(|error| anyhow!("{error}")))
        .with_context(|| format!("cannot draw {}", out.display()))?;
    eprintln!("drew {}", out.display());
    Ok(())
}

fn read(argument: &str, quantity: Quantity) -> Result<Curve> {
    let (label, path) = match argument.split_once('=') {
        Some((label, path)) => (label.to_owned(), PathBuf::from(path)),
        None => (name_of(Path::new(argument)), PathBuf::from(argument)),
    };
    let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let mut points = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let line: Line = serde_json::from_str(line)
            .with_context(|| format!("{}:{}: no line of metrics", path.display(), number + 1))?;
        if let Some(value) = quantity.of(&line) {
            points.push((line.seconds / 60.0, line.environment_steps as f64 / 1e6, value));
        }
    }
    if points.is_empty() {
        bail!("{} holds no finished episode yet", path.display());
    }
    Ok(Curve { label, points: smooth(&points) })
}

/// A run's metrics are called after its directory, other files by their own name.
fn name_of(path: &Path) -> String {
    let named = if path.file_stem().is_some_and(|stem| stem == "metrics") { path.parent() } else { Some(path) };
    named.and_then(Path::file_stem).unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// The mean of each point and the few before it.
fn smooth(points: &[(f64, f64, f64)]) -> Vec<(f64, f64, f64)> {
    (0..points.len())
        .map(|index| {
            let window = &points[(index + 1).saturating_sub(SMOOTHED_OVER)..=index];
            let mean = window.iter().map(|point| point.2).sum::<f64>() / window.len() as f64;
            (points[index].0, points[index].1, mean)
        })
        .collect()
}

fn draw<B: DrawingBackend>(area: &DrawingArea<B, Shift>, curves: &[Curve], quantity: Quantity) -> Result<()> {
    area.fill(&WHITE).map_err(|error| anyhow!("{error}"))?;
    let halves = area.split_evenly((1, 2));
    let [left, right] = halves.as_slice() else { return Err(anyhow!("the picture cannot be halved")) };
    panel(left, curves, "minutes of wall clock", quantity.label(), |point| point.0)?;
    panel(right, curves, "million environment steps", quantity.label(), |point| point.1)
}

fn panel<B: DrawingBackend>(
    area: &DrawingArea<B, Shift>,
    curves: &[Curve],
    x_label: &str,
    y_label: &str,
    x: impl Fn(&(f64, f64, f64)) -> f64 + Copy,
) -> Result<()> {
    let points = || curves.iter().flat_map(|curve| &curve.points);
    let x_range = 0.0..points().map(x).fold(1e-6, f64::max);
    let y_range = range_of(points().map(|point| point.2));
    let failed = |error: String| anyhow!(error);
    let mut chart = ChartBuilder::on(area)
        .margin(12)
        .x_label_area_size(36)
        .y_label_area_size(48)
        .build_cartesian_2d(x_range, y_range)
        .map_err(|error| failed(error.to_string()))?;
    chart
        .configure_mesh()
        .x_desc(x_label)
        .y_desc(y_label)
        .light_line_style(TRANSPARENT)
        .draw()
        .map_err(|error| failed(error.to_string()))?;
    for (index, curve) in curves.iter().enumerate() {
        let colour = Palette99::pick(index).to_rgba();
        let line = LineSeries::new(curve.points.iter().map(|point| (x(point), point.2)), colour.stroke_width(2));
        chart
            .draw_series(line)
            .map_err(|error| failed(error.to_string()))?
            .label(&curve.label)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour.stroke_width(2)));
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::LowerRight)
        .background_style(WHITE.mix(0.8))
        .draw()
        .map_err(|error| failed(error.to_string()))
}

/// From 0, or below it, to a little above the largest value.
fn range_of(values: impl Iterator<Item = f64> + Clone) -> Range<f64> {
    let low = values.clone().fold(0.0, f64::min);
    let high = values.fold(low + 1e-6, f64::max);
    low..high + 0.05 * (high - low)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_and_a_baseline_are_drawn_into_one_picture_with_both_axes_and_names() {
        let directory = tempfile::tempdir().unwrap();
        let run = directory.path().join("walk-1");
        std::fs::create_dir(&run).unwrap();
        let ours = "{\"seconds\":60,\"environment_steps\":1000000,\"episode_return\":2.0}\n";
        std::fs::write(run.join("metrics.jsonl"), ours.repeat(3)).unwrap();
        let baseline = directory.path().join("sb3.jsonl");
        std::fs::write(&baseline, "{\"seconds\": 30, \"env_steps\": 8030, \"episode_return\": 1.0}\n").unwrap();
        let out = directory.path().join("curve.svg");
        let metrics = [run.join("metrics.jsonl").display().to_string(), format!("PPO={}", baseline.display())];
        super::run(&metrics, Quantity::EpisodeReturn, &out).unwrap();
        let picture = std::fs::read_to_string(out).unwrap();
        for text in ["walk-1", "PPO", "minutes of wall clock", "million environment steps"] {
            assert!(picture.contains(text), "{text} is missing");
        }
    }

    #[test]
    fn smoothing_keeps_a_constant_and_never_looks_ahead() {
        let constant = smooth(&[(0.0, 0.0, 2.0); 9]);
        assert!(constant.iter().all(|point| point.2 == 2.0));
        let step = smooth(&[(0.0, 0.0, 0.0), (1.0, 1.0, 0.0), (2.0, 2.0, 3.0)]);
        assert_eq!(step.iter().map(|point| point.2).collect::<Vec<_>>(), [0.0, 0.0, 1.0]);
    }

    #[test]
    fn a_file_that_is_no_metrics_is_refused_by_line() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("metrics.jsonl");
        std::fs::write(&path, "{}\nnonsense\n").unwrap();
        let error = read(&path.display().to_string(), Quantity::EpisodeReturn).err().unwrap();
        assert!(format!("{error:#}").contains("metrics.jsonl:2"), "{error:#}");
    }
}
