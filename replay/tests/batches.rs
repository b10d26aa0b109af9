//! A batch has the inserted unrolls in the right slots, field by field.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use comic_proto::Invalid;
use comic_proto::v1::UnrollHeader;
use comic_replay::{Batch, BatchOrder, Batcher, Config, Ledger, Outcome, Phase};
use common::{Actor, CONFIG, PHASE, SLOTS, assert_holds, batch_now, batcher, insert_now, layout, payload};
use proptest::prelude::*;

#[test]
fn fields_are_contiguous_and_in_order_of_arrival_also_in_reused_buffers() {
    let batcher = batcher();
    let actors = [5, 6].map(|incarnation| Actor::join(&batcher, incarnation));
    for round in 0..10 {
        let mut sent = Vec::new();
        for slot in 0..CONFIG.unrolls {
            let actor = actors[slot % 2];
            let header = actor.header(round * 2 + slot as u64 / 2);
            assert_eq!(actor.send(&batcher, header.sequence), Some(Outcome::Taken));
            sent.push(header);
        }
        let batch = batch_now(&batcher).unwrap();
        assert_holds(&batch, &sent);
        batcher.trained(batch);
    }
    assert_eq!(batcher.accounting().trained, 30);
}

#[test]
fn two_batches_are_assembled_while_one_is_trained_on() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    for sequence in 0..3 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
    }
    let first = batch_now(&batcher).unwrap();
    for sequence in 3..3 + SLOTS as u64 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
    }
    assert_eq!(actor.send(&batcher, 9), None);
    assert_holds(&first, &[0, 1, 2].map(|sequence| actor.header(sequence)));
    // The trainer may take a second batch before it returns the first one. Memory is still three batches.
    let second = batch_now(&batcher).unwrap();
    assert_holds(&second, &[3, 4, 5].map(|sequence| actor.header(sequence)));
    assert_eq!(actor.send(&batcher, 9), None);
    batcher.trained(first);
    assert_eq!(actor.send(&batcher, 9), Some(Outcome::Taken));
    assert_holds(&second, &[3, 4, 5].map(|sequence| actor.header(sequence)));
    assert!(batcher.accounting().balance());
}

#[test]
fn unrolls_that_become_stale_while_they_wait_are_dropped_and_their_slots_are_reused() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    let newest = |late: u64| PHASE.version + late;
    let mut sent = Vec::new();
    // A full batch with two unrolls at the age limit. The open batch has one unroll at the limit and one new unroll.
    for (sequence, version) in (0..).zip([newest(0) - 4, newest(0), newest(0) - 4, newest(0) - 4, newest(0)]) {
        let header = UnrollHeader { version, ..actor.header(sequence) };
        assert_eq!(insert_now(&batcher, &header), Some(Outcome::Taken));
        sent.push(header);
    }
    batcher.set_phase(Phase { version: newest(1), ..PHASE });
    assert!(batch_now(&batcher).is_none(), "one slot is free");
    assert_eq!((batcher.accounting().dropped.stale, batcher.accounting().in_flight), (3, 2));
    let late = UnrollHeader { version: newest(1), ..actor.header(5) };
    assert_eq!(insert_now(&batcher, &late), Some(Outcome::Taken));
    assert_holds(&batch_now(&batcher).unwrap(), &[sent[4].clone(), sent[1].clone(), late]);
    // All slots are free again.
    for sequence in 6..6 + SLOTS as u64 {
        assert_eq!(insert_now(&batcher, &actor.header(sequence)), Some(Outcome::Taken));
    }
    assert_eq!(insert_now(&batcher, &actor.header(99)), None);
}

#[test]
fn a_batch_can_be_assembled_from_recorded_unrolls() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    let recorded = [actor.header(7), actor.header(3)];
    let unrolls: Vec<_> = recorded.iter().map(|header| (header.clone(), payload(header))).collect();
    let batch = Batch::assemble(layout(), unrolls.clone()).unwrap();
    assert_holds(&batch, &recorded);
    batcher.trained(batch);
    assert_eq!(batcher.accounting().trained, 0, "the batch does not belong to this batcher");

    let short = unrolls[0].1.slice(1..);
    let refused = Batch::assemble(layout(), [(recorded[0].clone(), short)]).err();
    assert_eq!(refused, Some(Invalid::Length { found: layout().size() - 1, expected: layout().size() }));
}

/// A batcher in which each environment has its own slot.
fn ordered() -> Batcher {
    let config = Config { ahead: 0, max_staleness: 0, order: BatchOrder::Environment, ..CONFIG };
    Batcher::new(layout(), config, PHASE, Ledger::new())
}

proptest! {
    #[test]
    fn for_every_order_of_arrival_an_unroll_is_in_the_slot_of_its_environment(
        orders in prop::collection::vec(Just([0_u32, 1, 2]).prop_shuffle(), 1..5),
    ) {
        let batcher = ordered();
        let actor = Actor::join(&batcher, 5);
        let mut sequence = 0..;
        for order in orders {
            let mut sent = order.map(|environment| {
                let header = UnrollHeader { environment, ..actor.header(sequence.next().unwrap()) };
                assert_eq!(insert_now(&batcher, &header), Some(Outcome::Taken));
                header
            });
            sent.sort_by_key(|header| header.environment);
            let batch = batch_now(&batcher).unwrap();
            assert_holds(&batch, &sent);
            batcher.trained(batch);
        }
        prop_assert!(batcher.accounting().balance());
    }
}

#[test]
fn an_unroll_whose_environment_has_no_free_slot_is_invalid() {
    let batcher = ordered();
    let actor = Actor::join(&batcher, 5);
    let send = |sequence, environment| insert_now(&batcher, &UnrollHeader { environment, ..actor.header(sequence) });
    assert_eq!(send(0, 1), Some(Outcome::Taken));
    assert_eq!(send(1, 1), Some(Outcome::Invalid));
    assert_eq!(send(2, 3), Some(Outcome::Invalid));
    assert_eq!(send(3, u32::MAX), Some(Outcome::Invalid));
    assert_eq!((send(4, 0), send(5, 2)), (Some(Outcome::Taken), Some(Outcome::Taken)));
    assert_eq!(batch_now(&batcher).unwrap().unrolls, 3);
    assert_eq!(batcher.accounting().dropped.invalid, 3);
}
