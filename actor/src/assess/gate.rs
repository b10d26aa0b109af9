//! The verdict on a low level: whether a new policy can explore with latents of its prior.

use serde::Serialize;

use super::row::{FEWEST, Row};
use super::source;

/// The median seconds upright under p(z | s), at least (D).
const MEDIAN_SECONDS: f64 = 4.0;
/// The standard deviation of headings under p(z | s), at least so many times that of a constant latent (D). Noise that leaves
/// every episode on the same way explores nothing.
const HEADING_FACTOR: f64 = 2.0;

/// Whether a low level passes. It must stay up under p(z | s), and go different ways.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Gate {
    /// Whether it passes every check.
    passed: bool,
    checks: [Check; 2],
}

/// A measured number that must be at least a bound.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Check {
    /// What is measured, with its unit.
    measure: &'static str,
    measured: Option<f64>,
    /// How the bound comes about.
    against: String,
    bound: Option<f64>,
    /// No, if the number or the bound is unknown.
    passed: bool,
}

impl Check {
    fn new(measure: &'static str, measured: Option<f64>, against: String, bound: Option<f64>) -> Self {
        let passed = measured.zip(bound).is_some_and(|(measured, bound)| measured >= bound);
        Self { measure, measured, against, bound, passed }
    }
}

impl Gate {
    /// The verdict on these rows; `None` if the low level has no prior of the state.
    pub(super) fn new(rows: &[Row]) -> Option<Self> {
        let find = |name: &str| rows.iter().find(|row| row.latents == name);
        let prior = find(source::PRIOR)?;
        let upright = Check::new(
            "median seconds upright of p(z | s)",
            Some(prior.median_seconds_upright),
            "the least".into(),
            Some(MEDIAN_SECONDS),
        );
        // A constant latent that falls at once goes nowhere. The prior's mean is the next best.
        let constant = [source::ZERO, source::MEAN].into_iter().filter_map(find);
        let constant = constant.filter_map(|row| Some((row.latents, row.heading_std?))).next();
        let (against, bound) = match constant {
            Some((name, std)) => (format!("{HEADING_FACTOR} × that of {name}"), Some(HEADING_FACTOR * std)),
            None => (format!("z = 0 and μ(s) have fewer than {FEWEST} upright episodes each"), None),
        };
        let headings = Check::new("heading_std of p(z | s), degrees", prior.heading_std, against, bound);
        Some(Self { passed: upright.passed && headings.passed, checks: [upright, headings] })
    }
}

/// The verdict in words, a line for each check.
pub(super) fn verdict(gate: Option<&Gate>) -> String {
    let Some(gate) = gate else {
        return "gate: no verdict, because the low level has no prior of the state\n".into();
    };
    let word = |passed| if passed { "pass" } else { "FAIL" };
    let number = |value: Option<f64>| value.map_or("–".into(), |value| format!("{value:.2}"));
    let mut text = format!("gate: {}\n", word(gate.passed));
    for Check { measure, measured, against, bound, passed } in &gate.checks {
        text += &format!(
            "  {:<6}{measure}: {}, at least {} ({against})\n",
            word(*passed),
            number(*measured),
            number(*bound)
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(latents: &'static str, median: f64, heading_std: Option<f64>) -> Row {
        Row { latents, median_seconds_upright: median, heading_std, ..Row::default() }
    }

    /// Whether each check of these rows passes.
    fn checks(rows: &[Row]) -> [bool; 2] {
        let gate = Gate::new(rows).unwrap();
        let passed = gate.checks.each_ref().map(|check| check.passed);
        assert_eq!(gate.passed, passed == [true; 2]);
        passed
    }

    #[test]
    fn it_passes_from_the_bounds_on() {
        let zero = row(source::ZERO, 1.0, Some(10.0));
        for (median, std, expected) in [
            (4.0, Some(20.0), [true, true]),
            (3.99, Some(20.0), [false, true]),
            (4.0, Some(19.9), [true, false]),
            (4.0, None, [true, false]),
        ] {
            assert_eq!(checks(&[row(source::PRIOR, median, std), zero.clone()]), expected, "{median} {std:?}");
        }
    }

    #[test]
    fn headings_are_compared_with_the_priors_mean_where_zero_falls() {
        let rows = |zero, mean| {
            [row(source::PRIOR, 9.0, Some(30.0)), row(source::MEAN, 9.0, mean), row(source::ZERO, 0.5, zero)]
        };
        assert_eq!(checks(&rows(None, Some(15.0))), [true, true]);
        assert_eq!(checks(&rows(None, Some(16.0))), [true, false]);
        assert_eq!(checks(&rows(Some(15.0), Some(16.0))), [true, true], "z = 0 counts if it is known");
        assert_eq!(checks(&rows(None, None)), [true, false], "nothing to compare with is no pass");
    }

    #[test]
    fn without_a_prior_there_is_no_verdict() {
        assert_eq!(Gate::new(&[row(source::ZERO, 9.0, Some(10.0))]), None);
        assert!(verdict(None).contains("no verdict"));
    }

    #[test]
    fn the_verdict_names_every_number_and_its_bound() {
        let rows = [row(source::PRIOR, 4.5, Some(19.0)), row(source::ZERO, 1.0, Some(10.0))];
        let expected = "gate: FAIL\n  pass  median seconds upright of p(z | s): 4.50, at least 4.00 (the least)\n  FAIL  \
                        heading_std of p(z | s), degrees: 19.00, at least 20.00 (2 × that of z = 0)\n";
        assert_eq!(verdict(Gate::new(&rows).as_ref()), expected);
    }
}
