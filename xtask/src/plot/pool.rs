//! Several runs of the same experiment as one curve: their mean, and a band with its 95 % bootstrap interval over the runs.

use super::bootstrap::interval;
use super::curve::Point;
use super::panel::Series;

/// Numbers of steps at which the runs are compared. Each run's own lines have other numbers.
const SAMPLES: usize = 200;

/// Gives `series` the mean and the interval of `curves` over the environment steps that all of them have. Each curve is
/// sorted by steps. A single curve is drawn as it is.
pub(super) fn pool(mut series: Series, curves: &[Vec<Point>]) -> Series {
    if let [only] = curves {
        return series.with_line(only.iter().map(|point| (point.steps, point.value)));
    }
    let from = curves.iter().filter_map(|curve| curve.first()).map(|point| point.steps).fold(0.0, f64::max);
    let to = curves.iter().filter_map(|curve| curve.last()).map(|point| point.steps).fold(f64::INFINITY, f64::min);
    if from > to || to.is_infinite() {
        return series;
    }
    for sample in 0..=SAMPLES {
        let steps = from + (to - from) * sample as f64 / SAMPLES as f64;
        let values: Vec<f64> = curves.iter().filter_map(|curve| at(curve, steps)).collect();
        let (low, high) = interval(&values);
        series.line.push((steps, values.iter().sum::<f64>() / values.len() as f64));
        series.band.push((steps, low, high));
    }
    series
}

/// The interpolated value of a curve at `steps`; its first or last value outside its range.
fn at(curve: &[Point], steps: f64) -> Option<f64> {
    let next = curve.partition_point(|point| point.steps < steps);
    match (next.checked_sub(1).and_then(|before| curve.get(before)), curve.get(next)) {
        (Some(before), Some(after)) => {
            let fraction = (steps - before.steps) / (after.steps - before.steps);
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
        points.iter().map(|(steps, value)| Point { minutes: 0.0, steps: *steps, value: *value }).collect()
    }

    fn pooled(curves: &[Vec<Point>]) -> Series {
        pool(Series::new("β", Kind::Training, 0), curves)
    }

    #[test]
    fn runs_are_compared_over_the_steps_of_all_of_them_by_interpolation() {
        // Of two runs the interval reaches from one to the other.
        let series = pooled(&[curve(&[(0.0, 0.0), (4.0, 4.0)]), curve(&[(1.0, 3.0), (2.0, 4.0), (3.0, 5.0)])]);
        assert_eq!((series.line[0], series.band[0]), ((1.0, 2.0), (1.0, 1.0, 3.0)));
        assert_eq!((series.line[SAMPLES], series.band[SAMPLES]), ((3.0, 4.0), (3.0, 3.0, 5.0)));
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
