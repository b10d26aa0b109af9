//! The store of sequences: uniform, bounded, and every sequence as it was inserted.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use comic_proto::Field;
use comic_replay::{Batch, Sample, Store, StoreError};
use common::{Actor, batch_now, batcher, layout, mark};
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

/// Batches of three unrolls, which are numbered from 0 on.
fn batches(count: u64, mut keep: impl FnMut(&Batch)) {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    for first in (0..count * 3).step_by(3) {
        for sequence in first..first + 3 {
            actor.send(&batcher, sequence);
        }
        let batch = batch_now(&batcher).unwrap();
        keep(&batch);
        batcher.trained(batch);
    }
}

/// The number of each sequence of a sample.
fn numbers(sample: &Sample) -> Vec<u32> {
    let rows = layout().elements(Field::Clip);
    sample.unrolls.clip().chunks_exact(rows).map(|clips| clips[0]).collect()
}

fn store(sequences: usize) -> Store {
    let steps = sequences * layout().shape().length;
    Store::new(layout(), steps, 1, u64::MAX).unwrap()
}

#[test]
fn the_oldest_sequences_make_room_and_the_rest_is_as_it_was_inserted() {
    let mut store = store(7);
    batches(5, |batch| {
        store.insert(batch);
        assert!(store.len() <= 7);
    });
    assert_eq!((store.len(), store.counts()), (7, (15, 0)));
    let mut sample = Sample::new(layout(), 7);
    assert!(store.sample(&mut sample, &mut Pcg64::seed_from_u64(1)));
    let mut found = numbers(&sample);
    let header = |number: u32| Actor::join(&batcher(), 5).header(u64::from(number));
    for (place, number) in found.iter().enumerate() {
        for field in Field::ALL.into_iter().filter(|field| *field != Field::Clip) {
            let (rows, width) = (layout().rows(field), layout().width(field));
            for t in 0..rows {
                let start = (place * rows + t) * width;
                let own = &sample.unrolls.f32(field)[start..start + width];
                assert_eq!(own, vec![mark(&header(*number), field, t); width], "{field}[{t}] of {number}");
            }
        }
    }
    found.sort_unstable();
    assert_eq!(found, [8, 9, 10, 11, 12, 13, 14], "each of the newest once");
}

#[test]
fn every_sequence_is_equally_likely_and_none_comes_twice_in_a_sample() {
    let mut store = store(20);
    batches(7, |batch| store.insert(batch));
    let (mut sample, mut random) = (Sample::new(layout(), 5), Pcg64::seed_from_u64(2));
    let mut counts = [0_u32; 20];
    let draws: u32 = 20_000;
    for _ in 0..draws {
        assert!(store.sample(&mut sample, &mut random));
        let mut found = numbers(&sample);
        found.iter().for_each(|number| counts[*number as usize - 1] += 1);
        found.sort_unstable();
        found.dedup();
        assert_eq!(found.len(), 5, "a sequence came twice");
    }
    let expected = f64::from(draws) * 5.0 / 20.0;
    let chi_squared: f64 = counts.iter().map(|count| (f64::from(*count) - expected).powi(2) / expected).sum();
    // 19 degrees of freedom: 43.8 is exceeded once in a thousand times. Draws without replacement vary less.
    assert!(chi_squared < 43.8, "{chi_squared}: {counts:?}");
    assert_eq!(store.counts(), (21, u64::from(draws) * 5));
}

#[test]
fn a_store_with_too_few_sequences_gives_no_sample() {
    let mut store = store(20);
    let mut sample = Sample::new(layout(), 5);
    assert!(store.is_empty() && !store.sample(&mut sample, &mut Pcg64::seed_from_u64(3)));
    batches(1, |batch| store.insert(batch));
    assert!(!store.sample(&mut sample, &mut Pcg64::seed_from_u64(3)));
    assert_eq!(store.counts(), (3, 0));
}

#[test]
fn a_store_that_memory_cannot_hold_is_refused() {
    let length = layout().shape().length;
    let small = Store::new(layout(), 4 * length, 5, u64::MAX).unwrap_err();
    assert_eq!(small, StoreError::Small { steps: 4 * length, capacity: 4, minibatch: 5 });
    let needed = 8 * layout().size() as u64;
    let large = Store::new(layout(), 8 * length, 5, needed - 1).unwrap_err();
    assert_eq!(large, StoreError::Memory { steps: 8 * length, needed, limit: needed - 1 });
    assert!(Store::new(layout(), 8 * length, 5, needed).is_ok());
}
