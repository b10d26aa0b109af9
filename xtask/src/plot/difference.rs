//! How far the curves of two runs are apart at the same environment steps.

use anyhow::{Context as _, Result, ensure};

use super::curve::{self, Axis, Point};
use super::pool::{at, places};
use super::{Quantity, Source};

/// Two curves of training, ours and theirs, over the environment steps that both of them have.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Difference {
    /// Environment steps at the end of the shorter one.
    pub(crate) until: u64,
    /// The mean of each curve over the last third.
    pub(crate) ours: f64,
    /// See `ours`.
    pub(crate) theirs: f64,
    /// Ours less theirs where they are furthest apart.
    pub(crate) largest: f64,
    /// The environment steps of that place.
    pub(crate) largest_at: u64,
}

/// Compares the smoothed curves of two runs.
///
/// # Errors
/// A file that cannot be read, a run without such a value, and runs without common environment steps.
pub(crate) fn difference(ours: &Source, theirs: &Source, quantity: Quantity) -> Result<Difference> {
    between(&[curve::training(ours, quantity)?, curve::training(theirs, quantity)?])
}

fn between(curves: &[Vec<Point>; 2]) -> Result<Difference> {
    let places = places(curves, Axis::EnvironmentSteps);
    ensure!(!places.is_empty(), "the two runs have no environment steps in common");
    let value = |curve: &[Point], place: f64| at(curve, Axis::EnvironmentSteps, place).context("a curve has no point");
    let values: Vec<_> = places
        .iter()
        .map(|place| Ok([value(&curves[0], *place)?, value(&curves[1], *place)?]))
        .collect::<Result<_>>()?;
    let end = &values[values.len() * 2 / 3..];
    let mean = |run: usize| end.iter().map(|values| values[run]).sum::<f64>() / end.len() as f64;
    let differences = places.iter().zip(&values).map(|(place, [ours, theirs])| (*place, ours - theirs));
    let furthest = differences.max_by(|(_, one), (_, other)| one.abs().total_cmp(&other.abs()));
    let (place, largest) = furthest.context("the two runs have no environment steps in common")?;
    let until = places.last().copied().unwrap_or_default();
    let steps = |millions: f64| (millions * 1e6).round() as u64;
    Ok(Difference { until: steps(until), ours: mean(0), theirs: mean(1), largest, largest_at: steps(place) })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(points: &[(f64, f64)]) -> Vec<Point> {
        points.iter().map(|(steps, value)| Point { minutes: 0.0, steps: *steps, value: *value }).collect()
    }

    #[test]
    fn the_curves_are_compared_over_their_common_steps() {
        // They are apart by 0.5 in the middle, and equal in the last third.
        let ours = curve(&[(0.0, 0.0), (1.5, 0.5), (2.0, 1.0), (3.0, 1.0), (9.0, 9.0)]);
        let theirs = curve(&[(0.0, 0.0), (1.5, 1.0), (2.0, 1.0), (3.0, 1.0)]);
        let found = between(&[ours, theirs]).unwrap();
        assert!((found.ours - 1.0).abs() < 1e-9 && (found.theirs - 1.0).abs() < 1e-9, "{found:?}");
        assert!((found.largest + 0.5).abs() < 1e-9 && found.largest_at == 1_500_000, "{found:?}");
        assert_eq!(found.until, 3_000_000);
    }

    #[test]
    fn runs_without_common_steps_are_refused() {
        let error = between(&[curve(&[(0.0, 1.0)]), curve(&[(1.0, 1.0)])]).unwrap_err().to_string();
        assert!(error.contains("no environment steps in common"), "{error}");
    }
}
