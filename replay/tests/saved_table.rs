//! A saved table is read as it was, and bytes that are no whole table are refused.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::io::{self, Read};
use std::sync::Arc;

use comic_proto::{UnrollLayout, UnrollShape};
use comic_replay::{Counts, ReadTableError, Table, TableConfig, TableError};
use common::items::{held, insert, numbers, sample, table, whole_layout};
use proptest::prelude::*;
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

/// Where the version, the hash of the layout, the counts and the items begin.
const VERSION: usize = 8;
const LAYOUT: usize = 12;
const COUNTS: usize = 44;
const ITEMS: usize = 68;

fn config(max_size: usize) -> TableConfig {
    TableConfig { max_size, sample_size: 1, memory: Table::memory(&whole_layout(), max_size) }
}

fn saved(table: &Table) -> Vec<u8> {
    let mut bytes = Vec::new();
    table.write_to(&mut bytes).unwrap();
    assert_eq!(bytes.len() as u64, table.saved_bytes());
    bytes
}

fn read(max_size: usize, bytes: impl Read) -> Result<Table, ReadTableError> {
    Table::read_from(whole_layout(), config(max_size), bytes)
}

/// A table of at most 4 items that evicted two.
fn example() -> Table {
    let mut table = table(4);
    insert(&mut table, 0..6);
    assert!(sample(&mut table, 3, &mut Pcg64::seed_from_u64(1)).is_some());
    table
}

/// These bytes with the checksum that they should have.
fn with_checksum(mut bytes: Vec<u8>) -> Vec<u8> {
    if let Some(end) = bytes.len().checked_sub(4) {
        let sum = crc32c::crc32c(&bytes[..end]);
        bytes[end..].copy_from_slice(&sum.to_le_bytes());
    }
    bytes
}

/// The example with other bytes at `start`, and the right checksum.
fn changed(start: usize, bytes: &[u8]) -> Vec<u8> {
    let mut whole = saved(&example());
    whole[start..start + bytes.len()].copy_from_slice(bytes);
    with_checksum(whole)
}

/// A reader that gives one byte at a time, with interruptions.
struct Single<'a>(&'a [u8], bool);

impl Read for Single<'_> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        self.1 = !self.1;
        if self.1 {
            return Err(io::ErrorKind::Interrupted.into());
        }
        let length = into.len().min(1);
        self.0.read(&mut into[..length])
    }
}

proptest! {
    /// The table that is read and the one that was saved are equal for ever, also if the new one is larger.
    #[test]
    fn a_round_trip_changes_nothing(
        max_size in 1_usize..10, larger in 0_usize..10, inserted in 0_u64..30, sampled in 0_usize..9, later in 0_u64..9,
        seed in any::<u64>(),
    ) {
        let mut before = table(max_size);
        insert(&mut before, 0..inserted);
        let mut random = Pcg64::seed_from_u64(seed);
        sample(&mut before, sampled, &mut random);
        let bytes = saved(&before);
        let mut after = read(max_size + larger, Single(&bytes, false)).unwrap();
        prop_assert_eq!((after.counts(), after.len(), after.evicted()), (before.counts(), before.len(), before.evicted()));
        prop_assert_eq!(saved(&after), bytes);
        for n in 0..=before.len() {
            let samples = [&mut before, &mut after].map(|table| {
                let sample = sample(table, n, &mut random.clone()).unwrap();
                (numbers(&sample), sample.ages)
            });
            prop_assert_eq!(&samples[0], &samples[1]);
        }
        if larger == 0 {
            [&mut before, &mut after].into_iter().for_each(|table| insert(table, inserted..inserted + later));
            prop_assert_eq!(held(&mut after), held(&mut before));
            prop_assert_eq!(after.counts(), before.counts());
        }
    }

    #[test]
    fn a_smaller_table_keeps_the_newest_items(max_size in 1_usize..8, smaller in 1_usize..8, inserted in 0_u64..30) {
        let mut before = table(max_size);
        insert(&mut before, 0..inserted);
        let mut after = read(smaller, &saved(&before)[..]).unwrap();
        let kept = before.len().saturating_sub(smaller);
        prop_assert_eq!(&held(&mut after), &held(&mut before)[kept..]);
        prop_assert_eq!(after.evicted(), before.evicted() + kept as u64);
    }

    /// Nothing that is read panics, or makes a table that panics later.
    #[test]
    fn hostile_bytes_are_refused_or_make_a_table(
        start in 0..ITEMS + 20, length in 0_usize..9, by in any::<u64>(), cut in prop::option::of(0_usize..2000),
        is_summed in any::<bool>(),
    ) {
        let mut bytes = saved(&example());
        bytes[start..start + length].iter_mut().zip(by.to_le_bytes()).for_each(|(byte, by)| *byte ^= by);
        bytes.truncate(cut.unwrap_or(usize::MAX));
        let bytes = if is_summed { with_checksum(bytes) } else { bytes };
        if let Ok(mut table) = read(4, &bytes[..]) {
            prop_assert!(table.len() <= 4);
            let mut random = Pcg64::seed_from_u64(1);
            prop_assert_eq!(sample(&mut table, 2, &mut random).is_some(), table.len() >= 2);
            insert(&mut table, 0..5);
            prop_assert_eq!(held(&mut table), [1, 2, 3, 4]);
        }
    }

    #[test]
    fn random_bytes_are_no_table(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        prop_assert!(read(4, &bytes[..]).is_err());
        prop_assert!(read(4, &[&saved(&example())[..ITEMS], &bytes].concat()[..]).is_err());
    }
}

#[test]
fn every_damaged_byte_and_every_cut_is_noticed() {
    let bytes = saved(&example());
    assert!(read(4, &bytes[..]).is_ok());
    for position in 0..bytes.len() {
        let mut damaged = bytes.clone();
        damaged[position] ^= 0x10;
        assert!(read(4, &damaged[..]).is_err(), "byte {position} of {}", bytes.len());
        assert!(matches!(read(4, &bytes[..position]), Err(ReadTableError::CutOff)), "{position} bytes");
    }
    let longer = [&bytes[..], &[0]].concat();
    assert!(matches!(read(4, &longer[..]), Err(ReadTableError::Trailing)));
}

#[test]
fn a_refusal_says_what_is_wrong() {
    let refusal = |bytes: Vec<u8>| read(4, &bytes[..]).unwrap_err();
    assert!(matches!(refusal(changed(0, b"x")), ReadTableError::Magic));
    assert!(matches!(refusal(changed(VERSION, &[2])), ReadTableError::Version { found: 2 }));
    assert!(matches!(refusal(changed(LAYOUT, &[0; 32])), ReadTableError::Layout));
    let mut damaged = saved(&example());
    damaged[ITEMS] ^= 1;
    assert!(matches!(refusal(damaged), ReadTableError::Checksum { .. }));
    let other = UnrollShape { action: 3, ..*whole_layout().shape() };
    let other = Table::read_from(Arc::new(UnrollLayout::new(other)), config(9), &saved(&example())[..]);
    assert!(matches!(other, Err(ReadTableError::Layout)));
    let small = TableConfig { memory: 100, ..config(4) };
    let small = Table::read_from(whole_layout(), small, &saved(&example())[..]);
    assert!(matches!(small, Err(ReadTableError::Table(TableError::Memory { limit: 100, .. }))));
}

#[test]
fn counts_that_cannot_be_are_refused() {
    let counts = |inserted: u64, sampled: u64, len: u64| {
        let bytes = changed(COUNTS, &[inserted, sampled, len].map(u64::to_le_bytes).concat());
        read(4, &bytes[..])
    };
    assert!(counts(6, 3, 4).is_ok());
    for (inserted, sampled, len) in [(3, 3, 4), (u64::MAX, 3, 4), (6, u64::MAX, 4), (u64::MAX, u64::MAX, u64::MAX)] {
        let counts = counts(inserted, sampled, len);
        assert!(matches!(counts, Err(ReadTableError::Counts { .. })), "{inserted} {sampled} {len}");
    }
    // A number of items that no memory could hold is not believed before they are there.
    assert!(matches!(counts(1 << 62, 3, 1 << 62), Err(ReadTableError::CutOff)));
    let mut last = counts(1 << 62, 1 << 62, 4).unwrap();
    insert(&mut last, 0..9);
    assert_eq!(held(&mut last), [5, 6, 7, 8]);
    assert_eq!(last.counts(), Counts { inserted: (1 << 62) + 9, sampled: (1 << 62) + 4 });
}

#[test]
fn what_reader_and_writer_report_is_passed_on() {
    struct Failing;
    impl Read for Failing {
        fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
            Err(io::ErrorKind::StorageFull.into())
        }
    }
    impl io::Write for Failing {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(io::ErrorKind::StorageFull.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }
    assert_eq!(example().write_to(Failing).unwrap_err().kind(), io::ErrorKind::StorageFull);
    let bytes = saved(&example());
    for position in [0, 20, ITEMS + 9, bytes.len()] {
        let read = read(4, bytes[..position].chain(Failing));
        assert!(matches!(read, Err(ReadTableError::Io(error)) if error.kind() == io::ErrorKind::StorageFull));
    }
}

#[cfg(target_os = "linux")]
#[test]
fn saving_and_reading_need_no_second_copy() {
    let peak = || common::memory_of_process("VmHWM:");
    let max_size = (64 << 20) / whole_layout().size();
    let mut before = table(max_size);
    let (unrolls, tasks) = common::items::items(0..1000);
    (0..max_size.div_ceil(1000)).for_each(|_| before.insert(&unrolls, &tasks));
    let at_first = peak();
    let (reader, writer) = io::pipe().unwrap();
    let after = std::thread::scope(|scope| {
        scope.spawn(|| before.write_to(writer).unwrap());
        read(max_size, reader).unwrap()
    });
    assert_eq!((after.len(), after.counts()), (before.len(), before.counts()));
    let more = peak() - at_first;
    assert!(more < Table::memory(&whole_layout(), max_size) + (4 << 20), "{more} bytes more");
}
