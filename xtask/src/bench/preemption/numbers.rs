//! A set of sequence numbers, in the memory of its ranges.

use std::collections::BTreeMap;
use std::ops::Range;

/// Each range by its start, with its end. No two of them touch.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Numbers(BTreeMap<u64, u64>);

impl Numbers {
    /// Adds a number.
    pub(super) fn insert(&mut self, number: u64) {
        let (mut start, mut end) = (number, number + 1);
        if let Some((&before, &its_end)) = self.0.range(..=number).next_back() {
            if its_end > number {
                return;
            }
            if its_end == number {
                start = before;
            }
        }
        if let Some(its_end) = self.0.remove(&end) {
            end = its_end;
        }
        self.0.insert(start, end);
    }

    /// One more than the largest number, and 0 without one.
    pub(super) fn end(&self) -> u64 {
        self.0.last_key_value().map_or(0, |(_, end)| *end)
    }

    /// The ranges below the largest number that are missing.
    pub(super) fn gaps(&self) -> impl Iterator<Item = Range<u64>> {
        let ends = std::iter::once(0).chain(self.0.values().copied());
        ends.zip(self.0.keys().copied()).map(|(end, start)| end..start).filter(|gap| !gap.is_empty())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(numbers: impl IntoIterator<Item = u64>) -> Numbers {
        let mut set = Numbers::default();
        numbers.into_iter().for_each(|number| set.insert(number));
        set
    }

    #[test]
    fn numbers_are_one_range_in_whatever_order_they_come() {
        for order in [[0, 1, 2, 3], [3, 2, 1, 0], [0, 2, 1, 3], [1, 3, 0, 2]] {
            assert_eq!(set(order), Numbers([(0, 4)].into()), "{order:?}");
        }
        assert_eq!(set([5, 5, 4, 4]), Numbers([(4, 6)].into()));
    }

    #[test]
    fn what_is_missing_below_the_largest_number_is_a_gap() {
        let numbers = set((2..10).chain(20..100));
        assert_eq!(numbers.gaps().collect::<Vec<_>>(), [0..2, 10..20]);
        assert_eq!(numbers.end(), 100);
        assert_eq!(set(0..100).gaps().count(), 0);
        assert_eq!((set([]).gaps().count(), set([]).end()), (0, 0));
    }
}
