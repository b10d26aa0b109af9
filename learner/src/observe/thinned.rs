//! A history of bounded length that covers a whole run.

/// An entry of a [`Thinned`] history.
pub(super) trait Entry {
    /// The learner epoch and the environment steps of the entry.
    fn place(&self) -> (u64, u64);

    /// Takes in the next newer entry: from now on, one entry stands for both.
    fn absorb(&mut self, newer: Self);
}

/// At most so many entries, oldest first. When there would be more, each two neighbours become one.
#[derive(Clone, Debug)]
pub(super) struct Thinned<E> {
    /// Each entry, and how many it stands for.
    entries: Vec<(E, usize)>,
    most: usize,
    /// How many a full entry stands for: a power of two.
    every: usize,
}

impl<E: Entry> Thinned<E> {
    /// An empty history of at most `most` entries, an even number.
    pub(super) fn new(most: usize) -> Self {
        Self { entries: Vec::new(), most, every: 1 }
    }

    /// Adds the newest entry. A learner that was killed repeats the steps after its checkpoint, so entries of earlier epochs that
    /// lie at these steps or after them go.
    pub(super) fn add(&mut self, entry: E) {
        let (epoch, steps) = entry.place();
        if self.entries.last().is_some_and(|(last, _)| last.place().0 < epoch) {
            self.entries.retain(|(earlier, _)| earlier.place().0 >= epoch || earlier.place().1 < steps);
        }
        match self.entries.last_mut() {
            Some((last, number)) if *number < self.every => {
                last.absorb(entry);
                *number += 1;
            }
            _ => {
                if self.entries.len() >= self.most {
                    self.halve();
                }
                self.entries.push((entry, 1));
            }
        }
    }

    /// The entries, oldest first.
    pub(super) fn iter(&self) -> impl ExactSizeIterator<Item = &E> {
        self.entries.iter().map(|(entry, _)| entry)
    }

    fn halve(&mut self) {
        let mut earlier = std::mem::take(&mut self.entries).into_iter();
        while let Some((mut first, mut number)) = earlier.next() {
            if let Some((second, more)) = earlier.next() {
                first.absorb(second);
                number += more;
            }
            self.entries.push((first, number));
        }
        self.every *= 2;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The numbers from the first to the last one.
    #[derive(Clone, Debug, PartialEq)]
    struct Range(u64, u64, u64);

    impl Entry for Range {
        fn place(&self) -> (u64, u64) {
            (self.0, self.2)
        }

        fn absorb(&mut self, newer: Self) {
            self.2 = newer.2;
        }
    }

    fn history(steps: impl IntoIterator<Item = (u64, u64)>) -> Thinned<Range> {
        let mut history = Thinned::new(4);
        steps.into_iter().for_each(|(epoch, step)| history.add(Range(epoch, step, step)));
        history
    }

    fn ranges(history: &Thinned<Range>) -> Vec<(u64, u64)> {
        history.iter().map(|range| (range.1, range.2)).collect()
    }

    #[test]
    fn a_long_history_is_covered_by_few_entries_of_equal_length() {
        assert_eq!(ranges(&history((1..=4).map(|step| (1, step)))), [(1, 1), (2, 2), (3, 3), (4, 4)]);
        assert_eq!(ranges(&history((1..=5).map(|step| (1, step)))), [(1, 2), (3, 4), (5, 5)]);
        assert_eq!(ranges(&history((1..=100).map(|step| (1, step)))), [(1, 32), (33, 64), (65, 96), (97, 100)]);
    }

    #[test]
    fn steps_that_a_restarted_learner_repeats_are_there_once() {
        let restarted = history([(1, 10), (1, 20), (1, 30), (2, 20), (2, 25)]);
        assert_eq!(ranges(&restarted), [(10, 10), (20, 20), (25, 25)]);
    }

    #[test]
    fn an_entry_of_the_same_epoch_replaces_none() {
        // Someone evaluates an older checkpoint.
        assert_eq!(ranges(&history([(1, 10), (1, 30), (1, 20)])), [(10, 10), (30, 30), (20, 20)]);
    }
}
