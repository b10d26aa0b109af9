//! How far the mean of a few runs may be from the mean of many.

use rand::SeedableRng as _;
use rand::seq::IndexedRandom as _;
use rand_pcg::Pcg64;

/// Number of resamples.
const RESAMPLES: usize = 1000;
/// The share of the resamples' means that lies within the interval.
const COVERED: f64 = 0.95;

/// The 95 % interval of the mean of `values` by the percentile bootstrap (Efron, 1979): as many values are drawn again and
/// again with replacement, and the interval holds the middle 95 % of the draws' means. Equal values, in any order, always
/// have the same interval. Both ends are NaN without a value.
pub(super) fn interval(values: &[f64]) -> (f64, f64) {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let mut random = Pcg64::seed_from_u64(1);
    let mut mean = || {
        let drawn = sorted.iter().filter_map(|_| sorted.choose(&mut random));
        drawn.sum::<f64>() / sorted.len() as f64
    };
    let mut means: Vec<f64> = (0..RESAMPLES).map(|_| mean()).collect();
    means.sort_by(f64::total_cmp);
    let at = |share: f64| means[((RESAMPLES - 1) as f64 * share).round() as usize];
    (at((1.0 - COVERED) / 2.0), at(f64::midpoint(1.0, COVERED)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_values_have_an_interval_without_width() {
        let (low, high) = interval(&[0.1; 3]);
        assert_eq!(low, high);
        assert!((low - 0.1).abs() < 1e-12, "{low}");
        assert_eq!(interval(&[0.25]), (0.25, 0.25));
    }

    #[test]
    fn the_interval_lies_within_the_values() {
        // Of two values a quarter of the draws has the smaller one twice, and another quarter the larger one.
        assert_eq!(interval(&[0.0, 1.0]), (0.0, 1.0));
        let (low, high) = interval(&[0.0, 0.25, 0.5, 0.75, 1.0]);
        assert!(0.0 < low && low < 0.5 && 0.5 < high && high < 1.0, "{low} to {high}");
    }

    #[test]
    fn the_order_of_the_values_does_not_matter() {
        assert_eq!(interval(&[0.3, 0.1, 0.7, 0.2]), interval(&[0.7, 0.2, 0.3, 0.1]));
    }

    #[test]
    fn no_value_has_no_interval() {
        let (low, high) = interval(&[]);
        assert!(low.is_nan() && high.is_nan());
    }
}
