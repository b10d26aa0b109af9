//! Order statistics.

/// The middle value, or the mean of the two middle values of an even count. `None` without values.
#[must_use]
pub fn median(values: Vec<f64>) -> Option<f64> {
    percentile(values, 50.0)
}

/// The value below which `percent` (0 to 100) of `values` lie, linear between neighbours: numpy's default method.
/// `None` without values.
#[must_use]
pub fn percentile(mut values: Vec<f64>, percent: f64) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    let position = percent / 100.0 * last as f64;
    let below = (position.floor() as usize).min(last);
    let above = (below + 1).min(last);
    Some(values[below] + (position - below as f64) * (values[above] - values[below]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn median_is_the_middle_value_in_any_order() {
        assert_eq!(median(vec![3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(vec![4.0, 1.0, 2.0, 3.0]), Some(2.5));
        assert_eq!(median(vec![]), None);
    }

    #[test]
    fn percentiles_are_linear_between_neighbours() {
        assert_eq!(percentile(vec![4.0, 1.0], 25.0), Some(1.75));
        assert_eq!(percentile(vec![4.0, 1.0, 2.0], 100.0), Some(4.0));
    }
}
