//! Memory is bounded: inserts wait if the batches are full, and a waiting insert can be cancelled.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::time::Duration;

use comic_replay::{Next, Outcome};
use common::{Actor, CONFIG, NEXT_PHASE, SLOTS, batch_now, batcher, now, payload};

#[test]
fn no_more_unrolls_than_an_open_and_a_full_batch_are_accepted() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    for sequence in 0..SLOTS as u64 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
    }
    assert_eq!(actor.send(&batcher, SLOTS as u64), None);
    assert_eq!(batcher.accounting().in_flight, SLOTS as u64);
    assert_eq!(batcher.accounting().produced, SLOTS as u64, "a cancelled insert is not recorded");
}

#[test]
fn an_unroll_that_is_refused_does_not_wait() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    for sequence in 0..SLOTS as u64 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
    }
    assert_eq!(actor.send(&batcher, 0), Some(Outcome::Duplicate));
    let mut header = actor.header(6);
    header.learner_epoch = 0;
    assert_eq!(common::insert_now(&batcher, &header), Some(Outcome::Superseded));
}

#[test]
fn waiting_inserts_get_slots_in_the_order_of_arrival() {
    let batcher = batcher();
    let filler = Actor::join(&batcher, 5);
    for sequence in 0..SLOTS as u64 {
        assert_eq!(filler.send(&batcher, sequence), Some(Outcome::Taken));
    }
    let headers: Vec<_> = (10..14).map(|incarnation| Actor::join(&batcher, incarnation).header(0)).collect();
    let mut waiting: Vec<_> = headers.iter().map(|header| Box::pin(batcher.insert(header, payload(header)))).collect();
    assert!(waiting.iter_mut().all(|insert| now(insert).is_none()));
    // The second insert is cancelled; the others still get their slots.
    drop(waiting.remove(1));
    batcher.trained(batch_now(&batcher).unwrap());
    assert!(waiting.iter_mut().all(|insert| now(insert) == Some(Outcome::Taken)));
    batcher.trained(batch_now(&batcher).unwrap());
    let actors: Vec<_> = batch_now(&batcher).unwrap().headers().iter().map(|header| header.actor).collect();
    assert_eq!(actors, [headers[0].actor, headers[2].actor, headers[3].actor]);
}

#[test]
fn only_one_of_two_waiting_copies_is_accepted() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    for sequence in 0..SLOTS as u64 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
    }
    let header = actor.header(SLOTS as u64);
    let mut old = Box::pin(batcher.insert(&header, payload(&header)));
    let mut new = Box::pin(batcher.insert(&header, payload(&header)));
    assert_eq!((now(&mut old), now(&mut new)), (None, None));
    batcher.trained(batch_now(&batcher).unwrap());
    assert_eq!((now(&mut old), now(&mut new)), (Some(Outcome::Taken), Some(Outcome::Duplicate)));
    assert_eq!(batcher.accounting().produced, SLOTS as u64 + 1);
}

#[test]
fn a_change_of_phase_ends_the_waiting_of_inserts_for_the_old_phase() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    for sequence in 0..SLOTS as u64 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
    }
    let header = actor.header(SLOTS as u64);
    let mut waiting = Box::pin(batcher.insert(&header, payload(&header)));
    assert_eq!(now(&mut waiting), None);
    batcher.set_phase(NEXT_PHASE);
    assert_eq!(now(&mut waiting), Some(Outcome::Superseded));
}

#[test]
fn closing_ends_all_waiting_and_records_nothing() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    for sequence in 0..SLOTS as u64 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
    }
    let header = actor.header(SLOTS as u64);
    let mut waiting = Box::pin(batcher.insert(&header, payload(&header)));
    assert_eq!(now(&mut waiting), None);
    let before = batcher.accounting();
    batcher.close();
    assert_eq!(now(&mut waiting), Some(Outcome::Closed));
    assert_eq!(actor.send(&batcher, 0), Some(Outcome::Closed));
    assert_eq!(batcher.refuse_invalid(&header), Outcome::Closed);
    assert!(batcher.next_batch().is_none());
    assert_eq!(batcher.accounting(), before);
}

#[test]
fn the_last_unroll_of_a_batch_or_closing_wakes_the_trainer() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    assert!(matches!(batcher.next_batch_within(Duration::from_millis(1)), Next::Elapsed));
    let (arrived, arrivals) = std::sync::mpsc::sync_channel(1);
    let trainer = std::thread::spawn({
        let batcher = batcher.clone();
        move || {
            while let Some(batch) = batcher.next_batch() {
                batcher.trained(batch);
                arrived.send(()).unwrap();
            }
        }
    });
    for sequence in 0..4 * CONFIG.unrolls as u64 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
        if (sequence + 1).is_multiple_of(CONFIG.unrolls as u64) {
            arrivals.recv().unwrap();
        }
    }
    batcher.close();
    trainer.join().unwrap();
    assert_eq!(batcher.accounting().trained, 12);
}

#[test]
fn no_unroll_is_lost_between_many_actors_and_one_trainer() {
    const ACTORS: u64 = 8;
    const EACH: u64 = 300;
    let batcher = batcher();
    let trainer = std::thread::spawn({
        let batcher = batcher.clone();
        move || {
            let mut seen = std::collections::HashSet::new();
            while seen.len() < (ACTORS * EACH) as usize {
                let batch = batcher.next_batch().unwrap();
                for header in batch.headers() {
                    assert!(seen.insert((header.actor, header.sequence)), "trained on twice");
                }
                batcher.trained(batch);
                assert!(batcher.accounting().balance());
            }
        }
    });
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(3).build().unwrap();
    runtime.block_on(async {
        let senders = (0..ACTORS).map(|incarnation| {
            let batcher = batcher.clone();
            tokio::spawn(async move {
                let actor = Actor::join(&batcher, incarnation);
                for sequence in 0..EACH {
                    let header = actor.header(sequence);
                    assert_eq!(batcher.insert(&header, payload(&header)).await, Outcome::Taken);
                }
            })
        });
        for sender in senders.collect::<Vec<_>>() {
            sender.await.unwrap();
        }
    });
    trainer.join().unwrap();
    let accounting = batcher.accounting();
    assert_eq!((accounting.produced, accounting.trained, accounting.in_flight), (ACTORS * EACH, ACTORS * EACH, 0));
}
