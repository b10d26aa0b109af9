//! The sampler is uniform, no item comes twice in a sample, and the ages are right.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::collections::HashMap;

use comic_replay::{Sample, Table};
use common::items::{held, insert, numbers, table, whole_layout};
use proptest::prelude::*;
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

/// How often each set of items comes in samples of `n` items.
fn sets(table: &mut Table, n: usize, draws: usize) -> HashMap<Vec<u64>, u32> {
    let (mut sample, mut random) = (Sample::new(whole_layout(), n), Pcg64::seed_from_u64(2));
    let mut counts = HashMap::new();
    for _ in 0..draws {
        assert!(table.sample(&mut sample, &mut random));
        let mut found = numbers(&sample);
        found.sort_unstable();
        *counts.entry(found).or_default() += 1;
    }
    counts
}

/// χ² of these counts if all `cells` are equally likely.
fn chi_squared(counts: impl Iterator<Item = u32>, cells: usize, draws: usize) -> f64 {
    let expected = draws as f64 / cells as f64;
    let counts: Vec<_> = counts.map(f64::from).chain(std::iter::repeat(0.0)).take(cells).collect();
    counts.iter().map(|count| (count - expected).powi(2) / expected).sum()
}

/// A table that is not full, one that is just full, and two whose oldest items were overwritten.
const INSERTED: [u64; 4] = [11, 20, 27, 58];

#[test]
fn every_item_is_equally_likely_also_after_the_table_wrapped_around() {
    for inserted in INSERTED {
        let mut table = table(20);
        insert(&mut table, 0..inserted);
        let cells = table.len();
        let counts = sets(&mut table, 1, 20_000);
        let found = chi_squared(counts.into_values(), cells, 20_000);
        // The quantiles of 0.999 for 10 and 19 degrees of freedom.
        let limit = if cells == 11 { 29.6 } else { 43.8 };
        assert!(found < limit, "{inserted} inserted: {found}");
    }
}

#[test]
fn every_set_of_items_is_equally_likely() {
    for inserted in [7, 17] {
        let mut table = table(7);
        insert(&mut table, 0..inserted);
        let counts = sets(&mut table, 3, 20_000);
        // There are 35 sets of 3 of 7 items: 34 degrees of freedom.
        let found = chi_squared(counts.into_values(), 35, 20_000);
        assert!(found < 65.2, "{inserted} inserted: {found}");
    }
}

proptest! {
    #[test]
    fn no_item_comes_twice_in_a_sample_and_its_age_is_the_number_of_later_inserts(
        max_size in 1_usize..30, inserted in 1_u64..90, n in 1_usize..30, seed in any::<u64>(),
    ) {
        let mut table = table(max_size);
        insert(&mut table, 0..inserted);
        let mut sample = Sample::new(whole_layout(), n);
        prop_assert_eq!(table.sample(&mut sample, &mut Pcg64::seed_from_u64(seed)), n <= table.len());
        if n <= table.len() {
            let mut found = numbers(&sample);
            let ages: Vec<_> = found.iter().map(|number| inserted - 1 - number).collect();
            prop_assert_eq!(&sample.ages, &ages);
            found.sort_unstable();
            found.dedup();
            prop_assert_eq!(found.len(), n);
            prop_assert!(found.iter().all(|number| held(&mut table).contains(number)));
        }
    }
}

#[test]
fn a_sample_depends_on_the_items_and_the_random_numbers_alone() {
    let draw = |table: &mut Table| {
        let mut sample = Sample::new(whole_layout(), 3);
        assert!(table.sample(&mut sample, &mut Pcg64::seed_from_u64(9)));
        numbers(&sample)
    };
    let (mut at_once, mut singly) = (table(5), table(5));
    insert(&mut at_once, 0..9);
    (0..9).for_each(|number| insert(&mut singly, [number]));
    assert_eq!(draw(&mut at_once), draw(&mut singly));
}
