//! The median of a figure's measurements.

/// The median of `values`, NaN where there are none.
pub(crate) fn median(values: Vec<f64>) -> f64 {
    comic_experiment::statistics::median(values).unwrap_or(f64::NAN)
}
