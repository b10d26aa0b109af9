//! A table never holds more than its bound, its oldest items leave first, and every item is as it was inserted.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::collections::VecDeque;

use comic_replay::{Counts, Sample, Table, TableConfig, TableError};
use common::items::{held, insert, items, sample, table, whole_layout};
use common::memory_of_process;
use proptest::prelude::*;
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

#[test]
fn the_oldest_item_leaves_first() {
    let mut table = table(4);
    insert(&mut table, 0..3);
    assert_eq!((held(&mut table), table.evicted()), (vec![0, 1, 2], 0));
    insert(&mut table, 3..6);
    assert_eq!((held(&mut table), table.evicted()), (vec![2, 3, 4, 5], 2));
    insert(&mut table, 6..16);
    assert_eq!((held(&mut table), table.evicted()), (vec![12, 13, 14, 15], 12));
}

proptest! {
    /// After any inserts and samples the table equals a queue that is cut off at its bound.
    #[test]
    fn a_table_is_a_bounded_queue(
        max_size in 1_usize..12, inserts in prop::collection::vec((0_u64..9, 0_usize..4), 0..30), seed in any::<u64>(),
    ) {
        let (mut table, mut queue) = (table(max_size), VecDeque::new());
        let (mut random, mut counts) = (Pcg64::seed_from_u64(seed), Counts::default());
        for (inserted, n) in inserts {
            let new = counts.inserted..counts.inserted + inserted;
            insert(&mut table, new.clone());
            queue.extend(new);
            counts.inserted += inserted;
            while queue.len() > max_size {
                queue.pop_front();
            }
            let sampled = sample(&mut table, n, &mut random);
            prop_assert_eq!(sampled.is_some(), queue.len() >= n);
            counts.sampled += sampled.map_or(0, |sample| sample.tasks.len() as u64);
            prop_assert_eq!(table.counts(), counts);
            prop_assert_eq!((table.len(), table.is_empty()), (queue.len(), queue.is_empty()));
            prop_assert_eq!(table.evicted(), counts.inserted - queue.len() as u64);
            // Looking at all items counts as sampling them.
            prop_assert_eq!(held(&mut table), queue.iter().copied().collect::<Vec<_>>());
            counts.sampled += queue.len() as u64;
        }
    }
}

#[test]
fn a_table_with_too_few_items_gives_no_sample() {
    let mut table = table(20);
    insert(&mut table, 0..3);
    let mut sample = Sample::new(whole_layout(), 4);
    (sample.tasks, sample.ages) = (vec![7; 4], vec![8; 4]);
    assert!(!table.sample(&mut sample, &mut Pcg64::seed_from_u64(3)));
    assert_eq!((sample.tasks, sample.ages), (vec![7; 4], vec![8; 4]), "the sample is unchanged");
    assert_eq!(table.counts(), Counts { inserted: 3, sampled: 0 });
}

#[test]
fn a_table_that_memory_cannot_hold_is_refused() {
    let config = |max_size, memory| TableConfig { max_size, sample_size: 5, memory };
    let small = Table::new(whole_layout(), config(4, u64::MAX)).unwrap_err();
    assert_eq!(small, TableError::Small { max_size: 4, sample_size: 5 });
    let needed = Table::memory(&whole_layout(), 8);
    assert_eq!(needed, 8 * (whole_layout().size() as u64 + 4), "an unroll and its task");
    let large = Table::new(whole_layout(), config(8, needed - 1)).unwrap_err();
    assert_eq!(large, TableError::Memory { max_size: 8, needed, limit: needed - 1 });
    assert!(Table::new(whole_layout(), config(8, needed)).is_ok());
    let huge = Table::new(whole_layout(), config(usize::MAX, u64::MAX - 1)).unwrap_err();
    assert!(matches!(huge, TableError::Memory { needed: u64::MAX, .. }), "{huge}");
    let nothing = TableConfig { max_size: 0, sample_size: 0, memory: u64::MAX };
    assert!(Table::new(whole_layout(), nothing).is_err());
}

/// The system gives memory when it is first written. It must do so at the start and not hours later, when there may be
/// none.
#[cfg(target_os = "linux")]
#[test]
fn memory_is_committed_when_the_table_is_made_and_does_not_grow() {
    let resident = || memory_of_process("VmRSS:");
    let max_size = (64 << 20) / whole_layout().size();
    let needed = Table::memory(&whole_layout(), max_size);
    let before = resident();
    let mut table = table(max_size);
    let made = resident();
    assert!(made - before > needed - (1 << 20), "{} of {needed} bytes", made - before);
    let (unrolls, tasks) = items(0..1000);
    for _ in 0..max_size.div_ceil(1000) {
        table.insert(&unrolls, &tasks);
    }
    assert_eq!(table.len(), max_size);
    assert!(resident() < made + (2 << 20), "{} bytes more", resident() - made);
}
