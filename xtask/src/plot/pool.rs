//! Several runs of the same experiment as one curve: their mean, and a band with its 95 % bootstrap interval over the runs.

use super::bootstrap::interval;
use super::curve::{Axis, Point};
use super::panel::Series;

/// Number of places at which the runs are compared. Each run's own lines are at other places.
const SAMPLES: usize = 200;

/// Gives `series` the mean and the interval of `curves` over the part of the axis that all of them have. Each curve is
/// sorted by time. A single curve is drawn as it is.
pub(super) fn pool(mut series: Series, curves: &[Vec<Point>], axis: Axis) -> Series {
    if let [only] = curves {
        return series.with_line(only.iter().map(|point| (point.on(axis), point.value)));
    }
    for place in places(curves, axis) {
        let values: Vec<f64> = curves.iter().filter_map(|curve| at(curve, axis, place)).collect();
        let (low, high) = interval(&values);
        series.line.push((place, values.iter().sum::<f64>() / values.len() as f64));
        series.band.push((place, low, high));
    }
    series
}

/// Places from the begin to the end of the part of the axis that all curves have; none if there is no such part.
pub(super) fn places(curves: &[Vec<Point>], axis: Axis) -> Vec<f64> {
    let from = curves.iter().filter_map(|curve| curve.first()).map(|point| point.on(axis)).fold(0.0, f64::max);
    let to = curves.iter().filter_map(|curve| curve.last()).map(|point| point.on(axis)).fold(f64::INFINITY, f64::min);
    if from > to || to.is_infinite() {
        return Vec::new();
    }
    (0..=SAMPLES).map(|sample| from + (to - from) * sample as f64 / SAMPLES as f64).collect()
}

/// The interpolated value of a curve at this place; its first or last value outside its range.
pub(super) fn at(curve: &[Point], axis: Axis, place: f64) -> Option<f64> {
    let next = curve.partition_point(|point| point.on(axis) < place);
    match (next.checked_sub(1).and_then(|before| curve.get(before)), curve.get(next)) {
        (Some(before), Some(after)) => {
            let fraction = (place - before.on(axis)) / (after.on(axis) - before.on(axis));
            Some(before.value + fraction * (after.value - before.value))
        }
        (before, after) => before.or(after).map(|point| point.value),
    }
}

#[cfg(test)]
mod tests {
    use super::super::panel::Kind;
    use super::*;

    fn curve(points: &[(f64, f64)]) -> Vec<Point> {
        points.iter().map(|(steps, value)| Point { minutes: 2.0 * steps, steps: *steps, value: *value }).collect()
    }

    fn pooled(curves: &[Vec<Point>]) -> Series {
        pool(Series::new("β", Kind::Training, 0), curves, Axis::EnvironmentSteps)
    }

    #[test]
    fn runs_are_compared_over_the_steps_of_all_of_them_by_interpolation() {
        // Of two runs the interval reaches from one to the other.
        let series = pooled(&[curve(&[(0.0, 0.0), (4.0, 4.0)]), curve(&[(1.0, 3.0), (2.0, 4.0), (3.0, 5.0)])]);
        assert_eq!((series.line[0], series.band[0]), ((1.0, 2.0), (1.0, 1.0, 3.0)));
        assert_eq!((series.line[SAMPLES], series.band[SAMPLES]), ((3.0, 4.0), (3.0, 3.0, 5.0)));
    }

    #[test]
    fn over_the_wall_clock_runs_are_compared_at_equal_minutes() {
        let curves = [curve(&[(0.0, 0.0), (4.0, 4.0)]), curve(&[(1.0, 3.0), (3.0, 5.0)])];
        let series = pool(Series::new("β", Kind::Training, 0), &curves, Axis::WallClock);
        assert_eq!((series.line[0], series.band[SAMPLES]), ((2.0, 2.0), (6.0, 3.0, 5.0)));
    }

    #[test]
    fn one_run_is_its_own_line_without_a_band() {
        let series = pooled(&[curve(&[(0.0, 1.0), (1.0, 2.0)])]);
        assert_eq!(series.line, [(0.0, 1.0), (1.0, 2.0)]);
        assert!(series.band.is_empty());
    }

    #[test]
    fn runs_without_common_steps_make_no_line() {
        assert!(pooled(&[curve(&[(0.0, 1.0)]), curve(&[(1.0, 1.0)])]).line.is_empty());
        assert!(pooled(&[]).line.is_empty());
    }
}
