//! The points of a run's curves.

use anyhow::{Result, bail};

use super::{Quantity, Source};
use crate::evaluations;
use crate::metrics;

/// Points of a smoothing window. The learner writes a line every few seconds.
const SMOOTHED_OVER: usize = 5;

/// What a quantity is drawn over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Axis {
    WallClock,
    EnvironmentSteps,
}

impl Axis {
    pub(super) fn label(self) -> &'static str {
        match self {
            Self::WallClock => "minutes of wall clock",
            Self::EnvironmentSteps => "million environment steps",
        }
    }
}

/// A quantity's value at a moment of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Point {
    pub(super) minutes: f64,
    /// Environment steps, millions.
    pub(super) steps: f64,
    pub(super) value: f64,
}

impl Point {
    pub(super) fn on(&self, axis: Axis) -> f64 {
        match axis {
            Axis::WallClock => self.minutes,
            Axis::EnvironmentSteps => self.steps,
        }
    }
}

/// The smoothed values of training's episodes.
///
/// # Errors
/// A file that cannot be read, or no value in it.
pub(super) fn training(source: &Source, quantity: Quantity) -> Result<Vec<Point>> {
    let mut points: Vec<Point> = Vec::new();
    for line in metrics::read(&source.path)? {
        let of_task = match &source.task {
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
        let of_task = source.task.as_ref().map_or_else(String::new, |task| format!(" of {task}"));
        bail!("{} has no finished episode{of_task} yet, or none with the {}", source.path.display(), quantity.label());
    }
    Ok(smooth(&points))
}

/// The evaluations without noise of the same run while it trained; none if the source is not a run's file of metrics.
///
/// # Errors
/// A file that cannot be read.
pub(super) fn evaluated(source: &Source, quantity: Quantity) -> Result<Vec<Point>> {
    let Some(path) = source.evaluations() else { return Ok(Vec::new()) };
    let point = |line: &evaluations::Line| -> Option<Point> {
        let means = match &source.task {
            Some(task) => line.evaluation.tasks.iter().find(|own| own.clip == *task)?,
            None => &line.evaluation.overall,
        };
        let value = quantity.of_evaluation(means)?;
        Some(Point { minutes: line.seconds / 60.0, steps: line.environment_steps as f64 / 1e6, value })
    };
    Ok(evaluations::read(&path)?.iter().filter_map(point).collect())
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

#[cfg(test)]
mod tests {
    use super::*;

    fn steps_and_values(points: &[Point]) -> Vec<(f64, f64)> {
        points.iter().map(|point| (point.steps, point.value)).collect()
    }

    #[test]
    fn a_named_tasks_episodes_are_drawn() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("metrics.jsonl");
        let line = r#"{"environment_steps":1000000,"episode_return":9.0,"tasks":{"get-up":{"episode_return":2.0}}}"#;
        std::fs::write(&path, format!("{line}\n")).unwrap();
        let of = |argument: &str| {
            let source = Source::parse(&argument.replace("FILE", &path.display().to_string()));
            training(&source, Quantity::EpisodeReturn).map(|points| steps_and_values(&points))
        };
        assert_eq!(of("FILE").unwrap(), [(1.0, 9.0)]);
        assert_eq!(of("up=FILE#get-up").unwrap(), [(1.0, 2.0)]);
        assert!(of("FILE#gaps").unwrap_err().to_string().contains("no finished episode of gaps yet"));
    }

    #[test]
    fn steps_repeated_after_a_crash_are_drawn_once() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("metrics.jsonl");
        let lines = [(1_000_000, 1.0), (2_000_000, 7.0), (3_000_000, 7.0), (2_000_000, 1.0), (4_000_000, 1.0)];
        let line =
            |(steps, value): (u64, f64)| format!("{{\"environment_steps\":{steps},\"episode_return\":{value}}}\n");
        std::fs::write(&path, lines.map(line).concat()).unwrap();
        let points = training(&Source::of(path), Quantity::EpisodeReturn).unwrap();
        assert_eq!(steps_and_values(&points), [(1.0, 1.0), (2.0, 1.0), (4.0, 1.0)]);
    }

    #[test]
    fn evaluations_are_read_from_the_runs_directory_and_not_smoothed() {
        let directory = tempfile::tempdir().unwrap();
        let lines = [(1_000_000, 0.25), (2_000_000, 0.75)];
        let text = lines.map(|(steps, reward)| evaluations::example(steps, &[("walk", reward)])).concat();
        std::fs::write(directory.path().join(evaluations::FILE), text).unwrap();
        let of = |file: &str, quantity| evaluated(&Source::of(directory.path().join(file)), quantity).unwrap();
        let points = of("metrics.jsonl", Quantity::NormalisedReward);
        assert_eq!(steps_and_values(&points), [(1.0, 0.25), (2.0, 0.75)]);
        assert_eq!(points[1].minutes, 2.0);
        assert_eq!(steps_and_values(&of("metrics.jsonl", Quantity::EpisodeReturn)), [(1.0, 12.5), (2.0, 37.5)]);
        assert!(of("baseline.jsonl", Quantity::NormalisedReward).is_empty(), "another program's file");
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
