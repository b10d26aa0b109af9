//! A trainer may take the unrolls that wait, without waiting for a full batch.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::time::Duration;

use comic_proto::v1::UnrollHeader;
use comic_replay::{Next, Outcome, Phase, Reason};
use common::{Actor, CONFIG, PHASE, SLOTS, assert_holds, available_now, batch_now, batcher, insert_now, now, payload};

#[test]
fn unrolls_are_given_without_a_full_batch_and_the_oldest_first() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    let header = |sequence| actor.header(sequence);
    assert_eq!(actor.send(&batcher, 0), Some(Outcome::Taken));
    let one = available_now(&batcher, 9).unwrap();
    assert_holds(&one, &[header(0)]);
    batcher.trained(one);
    // A full batch, and two unrolls of the next one.
    for sequence in 1..6 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
    }
    for expected in [[1, 2], [3, 4]] {
        let two = available_now(&batcher, 2).unwrap();
        assert_holds(&two, &expected.map(header));
        batcher.trained(two);
    }
    assert_eq!(actor.send(&batcher, 6), Some(Outcome::Taken));
    let rest = available_now(&batcher, 9).unwrap();
    assert_holds(&rest, &[header(5), header(6)]);
    batcher.trained(rest);
    assert_eq!((batcher.accounting().trained, batcher.accounting().in_flight), (7, 0));
}

#[test]
fn every_slot_is_used_again() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    let mut sequences = 0..;
    for at_most in [1, 2, 3, 4, 9] {
        while actor.send(&batcher, sequences.start) == Some(Outcome::Taken) {
            sequences.next();
        }
        assert_eq!(batcher.accounting().in_flight, SLOTS as u64);
        while let Some(batch) = available_now(&batcher, at_most) {
            batcher.trained(batch);
        }
        assert_eq!(batcher.accounting().in_flight, 0);
    }
}

#[test]
fn inserts_go_on_while_the_trainer_holds_what_it_took() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    assert_eq!(actor.send(&batcher, 0), Some(Outcome::Taken));
    let held = available_now(&batcher, 1).unwrap();
    for sequence in 1..=SLOTS as u64 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
    }
    assert_eq!(actor.send(&batcher, 99), None, "every slot is filled");
    assert_holds(&held, &[actor.header(0)]);
    batcher.trained(held);
    assert_eq!(actor.send(&batcher, 99), None, "the memory of the trainer is not filled");
}

#[test]
fn a_full_batch_and_what_is_available_can_be_taken_in_turn() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    for sequence in 0..5 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
    }
    let one = available_now(&batcher, 1).unwrap();
    assert_holds(&one, &[actor.header(0)]);
    // The open batch has filled the free slot.
    let full = batch_now(&batcher).unwrap();
    let mut sequences: Vec<_> = full.headers().iter().map(|header| header.sequence).collect();
    sequences.sort_unstable();
    assert_eq!(sequences, [1, 2, 3]);
    batcher.discard(full, Reason::Superseded);
    drop(one);
    let last = available_now(&batcher, 9).unwrap();
    assert_holds(&last, &[actor.header(4)]);
    batcher.trained(last);
    let accounting = batcher.accounting();
    let ended = (accounting.trained, accounting.dropped.superseded, accounting.dropped.lost_at_restart);
    assert_eq!((accounting.produced, accounting.in_flight, ended), (5, 0, (1, 3, 1)));
}

#[test]
fn nothing_is_given_if_nothing_waits_or_nothing_is_wanted() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    let next = |at_most| batcher.next_available_within(Duration::from_millis(1), at_most);
    assert!(matches!(next(9), Next::Elapsed));
    for sequence in 0..SLOTS as u64 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
    }
    assert!(matches!(next(0), Next::Elapsed));
    assert_eq!(batcher.accounting().in_flight, SLOTS as u64);
    batcher.close();
    assert!(matches!(next(9), Next::Closed) && matches!(next(0), Next::Closed));
}

#[test]
fn stale_unrolls_are_dropped_and_not_given() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    let oldest = PHASE.version - CONFIG.max_staleness;
    let versions = [oldest, PHASE.version, oldest, oldest, PHASE.version];
    for (sequence, version) in (0..).zip(versions) {
        let header = UnrollHeader { version, ..actor.header(sequence) };
        assert_eq!(insert_now(&batcher, &header), Some(Outcome::Taken));
    }
    batcher.set_phase(Phase { version: PHASE.version + 1, ..PHASE });
    let fresh = available_now(&batcher, 9).unwrap();
    assert_eq!(fresh.headers().iter().map(|header| header.sequence).collect::<Vec<_>>(), [1, 4]);
    assert_eq!(batcher.accounting().dropped.stale, 3);
    batcher.trained(fresh);
    batcher.set_phase(Phase { version: PHASE.version + 9, ..PHASE });
    assert!(available_now(&batcher, 9).is_none());
}

#[test]
fn waiting_inserts_get_as_many_slots_as_unrolls_were_taken() {
    let batcher = batcher();
    let filler = Actor::join(&batcher, 5);
    for sequence in 0..SLOTS as u64 {
        assert_eq!(filler.send(&batcher, sequence), Some(Outcome::Taken));
    }
    let headers: Vec<_> = (10..14).map(|incarnation| Actor::join(&batcher, incarnation).header(0)).collect();
    let mut waiting: Vec<_> = headers.iter().map(|header| Box::pin(batcher.insert(header, payload(header)))).collect();
    assert!(waiting.iter_mut().all(|insert| now(insert).is_none()));
    batcher.trained(available_now(&batcher, 2).unwrap());
    // The first has a slot already when it is cancelled; the slot goes to the third.
    drop(waiting.remove(0));
    let outcomes: Vec<_> = waiting.iter_mut().map(now).collect();
    assert_eq!(outcomes, [Some(Outcome::Taken), Some(Outcome::Taken), None]);
    let mut actors = Vec::new();
    while let Some(batch) = available_now(&batcher, 4) {
        actors.extend(batch.headers().iter().map(|header| header.actor));
        batcher.trained(batch);
    }
    let others = [headers[1].actor, headers[2].actor];
    assert_eq!(actors, [[filler.actor; SLOTS - 2].as_slice(), &others].concat());
}

#[test]
fn an_unroll_or_closing_wakes_the_trainer() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    let (arrived, arrivals) = std::sync::mpsc::sync_channel(1);
    let trainer = std::thread::spawn({
        let batcher = batcher.clone();
        move || {
            while let Next::Batch(batch) = batcher.next_available_within(Duration::MAX, 2) {
                let unrolls = batch.unrolls;
                batcher.trained(batch);
                arrived.send(unrolls).unwrap();
            }
        }
    });
    for sequence in 0..10 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
        assert_eq!(arrivals.recv().unwrap(), 1);
    }
    batcher.close();
    trainer.join().unwrap();
    assert_eq!(batcher.accounting().trained, 10);
}

#[test]
fn memory_that_is_given_back_wakes_the_trainer() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    for sequence in 0..SLOTS as u64 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
    }
    // The trainer holds all the memory that is certain for it, and there is no other.
    let held: Vec<_> = std::iter::from_fn(|| available_now(&batcher, 1)).collect();
    assert!(!held.is_empty() && held.len() < SLOTS);
    let (asks, asked) = std::sync::mpsc::sync_channel(1);
    let other = std::thread::spawn({
        let batcher = batcher.clone();
        move || {
            asks.send(()).unwrap();
            batcher.next_available_within(Duration::MAX, 1)
        }
    });
    asked.recv().unwrap();
    drop(held);
    assert!(matches!(other.join().unwrap(), Next::Batch(batch) if batch.unrolls == 1));
}
