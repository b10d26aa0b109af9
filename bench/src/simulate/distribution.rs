//! How often values occurred, in bounded memory.

use std::collections::BTreeMap;

/// The last bits of a number that are not kept. Ten bits of its fraction are, so a value is at most a thousandth too small.
const DROPPED_BITS: u32 = 42;

/// Counts numbers from 0, whatever their size: a simulation can have billions of them.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Distribution {
    /// By the first bits of the number, whose order is that of the numbers.
    counts: BTreeMap<u64, u64>,
}

impl Distribution {
    pub(super) fn add(&mut self, value: f64) {
        // A difference of times may be just below 0.
        let bits = if value > 0.0 { value.to_bits() >> DROPPED_BITS } else { 0 };
        *self.counts.entry(bits).or_default() += 1;
    }

    /// The value that `percent` of the values do not exceed.
    pub(super) fn quantile(&self, percent: u64) -> Option<f64> {
        quantile(&self.counts, percent).map(|bits| f64::from_bits(bits << DROPPED_BITS))
    }
}

/// The key that `percent` of all that is counted do not exceed.
pub(super) fn quantile(counts: &BTreeMap<u64, u64>, percent: u64) -> Option<u64> {
    let all: u64 = counts.values().sum();
    let mut left = (all * percent).div_ceil(100).max(1);
    let found = counts.iter().find(|(_, count)| {
        let reached = **count >= left;
        left = left.saturating_sub(**count);
        reached
    });
    found.map(|(key, _)| *key)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_key_at_a_percentage_is_that_of_a_sorted_list() {
        let ages = [(0, 60), (2, 39), (7, 1)].into();
        assert_eq!([50, 60, 61, 99, 100].map(|percent| quantile(&ages, percent)), [0, 0, 2, 2, 7].map(Some));
        assert_eq!(quantile(&[].into(), 50), None);
    }

    #[test]
    fn a_value_is_at_most_a_thousandth_too_small() {
        for value in [1e-9, 0.123_456, 1.0, 59.999_999, 3e9] {
            let mut values = Distribution::default();
            values.add(value);
            let kept = values.quantile(50).unwrap();
            assert!(kept <= value && kept >= value * 0.999, "{kept} for {value}");
        }
    }

    #[test]
    fn small_whole_numbers_are_exact() {
        let mut values = Distribution::default();
        (0..=1000).for_each(|number| values.add(f64::from(number)));
        assert_eq!([0, 50, 99, 100].map(|percent| values.quantile(percent)), [0.0, 500.0, 990.0, 1000.0].map(Some));
    }

    #[test]
    fn memory_does_not_grow_with_the_number_of_values() {
        let mut values = Distribution::default();
        (0..100_000).for_each(|number| values.add(1.0 + f64::from(number) / 100_000.0));
        assert!(values.counts.len() <= 1024);
    }
}
