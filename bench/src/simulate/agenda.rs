//! A queue in the order of a number.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// Gives the item with the smallest number first, and of equal ones that which was added first.
#[derive(Debug)]
pub(super) struct Agenda<T> {
    items: BinaryHeap<Item<T>>,
    added: u64,
}

#[derive(Debug)]
struct Item<T> {
    at: f64,
    order: u64,
    what: T,
}

impl<T> Agenda<T> {
    pub(super) fn new() -> Self {
        Self { items: BinaryHeap::new(), added: 0 }
    }

    pub(super) fn add(&mut self, at: f64, what: T) {
        self.added += 1;
        self.items.push(Item { at, order: self.added, what });
    }

    pub(super) fn first(&self) -> Option<(f64, &T)> {
        self.items.peek().map(|item| (item.at, &item.what))
    }

    pub(super) fn take_first(&mut self) -> Option<(f64, T)> {
        self.items.pop().map(|item| (item.at, item.what))
    }
}

impl<T> Ord for Item<T> {
    fn cmp(&self, other: &Self) -> Ordering {
        // The heap gives the greatest first.
        other.at.total_cmp(&self.at).then(other.order.cmp(&self.order))
    }
}

impl<T> PartialOrd for Item<T> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl<T> PartialEq for Item<T> {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl<T> Eq for Item<T> {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_smallest_number_comes_first_and_of_equal_ones_the_older() {
        let mut agenda = Agenda::new();
        [(2.0, 'c'), (1.0, 'a'), (1.0, 'b')].into_iter().for_each(|(at, what)| agenda.add(at, what));
        assert_eq!(agenda.first(), Some((1.0, &'a')));
        let taken: Vec<char> = std::iter::from_fn(|| agenda.take_first()).map(|(_, what)| what).collect();
        assert_eq!(taken, ['a', 'b', 'c']);
    }
}
