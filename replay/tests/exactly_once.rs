//! Each unroll is accepted at most once, and every refusal is counted with its reason.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use comic_proto::MAX_SEQUENCE;
use comic_replay::{Dropped, MOST_LOST, Outcome, Phase, Reason};
use common::{Actor, CONFIG, NEXT_PHASE, PHASE, batch_now, batcher, insert_now, payload};

#[test]
fn an_unroll_that_is_sent_twice_is_accepted_once() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    assert_eq!(actor.send(&batcher, 0), Some(Outcome::Taken));
    assert_eq!(actor.send(&batcher, 0), Some(Outcome::Duplicate));
    assert_eq!(actor.send(&batcher, 1), Some(Outcome::Taken));
    assert_eq!(actor.send(&batcher, 0), Some(Outcome::Duplicate));
    let accounting = batcher.accounting();
    assert_eq!((accounting.produced, accounting.in_flight, accounting.duplicates), (2, 2, 2));
}

#[test]
fn skipped_sequence_numbers_are_lost_and_later_refused() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    assert_eq!(actor.send(&batcher, 4), Some(Outcome::Taken));
    assert_eq!(actor.send(&batcher, 2), Some(Outcome::Duplicate));
    let accounting = batcher.accounting();
    assert_eq!((accounting.produced, accounting.in_flight, accounting.dropped.lost_at_restart), (5, 1, 4));
}

#[test]
fn two_incarnations_have_separate_accounts() {
    let batcher = batcher();
    let (one, other) = (Actor::join(&batcher, 5), Actor::join(&batcher, 6));
    assert_ne!(one.actor, other.actor);
    assert_eq!(one.send(&batcher, 0), Some(Outcome::Taken));
    assert_eq!(other.send(&batcher, 0), Some(Outcome::Taken));
    assert_eq!(batcher.accounting().produced, 2);
}

/// An actor that could claim any number would bring the sums to their end.
#[test]
fn more_unrolls_than_an_actor_can_make_are_not_lost() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    assert_eq!(batcher.catch_up(actor.actor, MOST_LOST + 1), None);
    assert_eq!(actor.send(&batcher, MOST_LOST + 1), Some(Outcome::Invalid));
    assert_eq!(batcher.accounting().produced, 0);
    assert_eq!(batcher.catch_up(actor.actor, MOST_LOST), Some(MOST_LOST));
    assert_eq!(actor.send(&batcher, 2 * MOST_LOST), Some(Outcome::Taken));
    assert_eq!(batcher.accounting().dropped.lost_at_restart, 2 * MOST_LOST);
}

#[test]
fn a_message_without_an_account_changes_no_account() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    let stranger = Actor { actor: 9, ..actor };
    let impostor = Actor { incarnation: 6, ..actor };
    assert_eq!(stranger.send(&batcher, 0), Some(Outcome::NotJoined));
    assert_eq!(impostor.send(&batcher, 0), Some(Outcome::NotJoined));
    assert_eq!(batcher.refuse_invalid(&stranger.header(0)), Outcome::NotJoined);
    assert_eq!(actor.send(&batcher, MAX_SEQUENCE), Some(Outcome::Invalid));
    assert_eq!(actor.send(&batcher, u64::MAX), Some(Outcome::Invalid));
    batcher.refuse_unattributed();
    let accounting = batcher.accounting();
    assert_eq!((accounting.produced, accounting.unattributed), (0, 6));
    assert_eq!(actor.send(&batcher, 0), Some(Outcome::Taken), "its account is unchanged");
}

#[test]
fn an_invalid_unroll_is_dropped_once_and_the_next_unroll_is_accepted() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    assert_eq!(batcher.refuse_invalid(&actor.header(0)), Outcome::Invalid);
    assert_eq!(batcher.refuse_invalid(&actor.header(0)), Outcome::Duplicate);
    let short = common::now(&mut Box::pin(batcher.insert(&actor.header(1), payload(&actor.header(1)).slice(4..))));
    assert_eq!(short, Some(Outcome::Invalid), "the batcher refuses a payload of another size");
    assert_eq!(actor.send(&batcher, 2), Some(Outcome::Taken));
    assert_eq!(batcher.accounting().dropped, Dropped { invalid: 2, ..Dropped::default() });
}

#[test]
fn staleness_is_counted_in_published_versions() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    let mut header = actor.header(0);
    header.version = PHASE.version - CONFIG.max_staleness;
    assert_eq!(insert_now(&batcher, &header), Some(Outcome::Taken));
    batcher.set_phase(Phase { version: PHASE.version + 1, ..PHASE });
    header.sequence = 1;
    assert_eq!(insert_now(&batcher, &header), Some(Outcome::Stale));
    let accounting = batcher.accounting();
    assert_eq!(
        (accounting.dropped.stale, accounting.in_flight),
        (1, 1),
        "a new version does not change the open batch"
    );
}

#[test]
fn unrolls_of_another_epoch_are_superseded() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    let (mut earlier, mut later) = (actor.header(0), actor.header(1));
    (earlier.learner_epoch, later.learner_epoch) = (PHASE.epoch - 1, PHASE.epoch + 1);
    assert_eq!(insert_now(&batcher, &earlier), Some(Outcome::Superseded));
    assert_eq!(insert_now(&batcher, &later), Some(Outcome::Superseded));
    batcher.set_phase(Phase { epoch: PHASE.epoch + 1, ..PHASE });
    later.sequence = 2;
    assert_eq!(insert_now(&batcher, &later), Some(Outcome::Taken));
    assert_eq!(batcher.accounting().dropped.superseded, 2);
}

#[test]
fn an_unroll_older_than_the_oldest_version_of_the_phase_is_superseded() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    assert_eq!(actor.send(&batcher, 0), Some(Outcome::Taken));
    batcher.set_phase(NEXT_PHASE);
    assert_eq!(actor.send(&batcher, 1), Some(Outcome::Superseded));
    assert_eq!(batcher.accounting().dropped.superseded, 2);
}

#[test]
fn a_change_of_phase_drops_the_unrolls_of_the_old_phase() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    for sequence in 0..6 {
        assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
    }
    assert_eq!(actor.send(&batcher, 6), None);
    batcher.set_phase(NEXT_PHASE);
    let accounting = batcher.accounting();
    assert_eq!((accounting.dropped.superseded, accounting.in_flight), (6, 0));
    assert!(batch_now(&batcher).is_none());
    for sequence in 6..12 {
        let mut header = actor.header(sequence);
        header.version = NEXT_PHASE.version;
        assert_eq!(insert_now(&batcher, &header), Some(Outcome::Taken), "all slots are free again");
    }
    assert!(batcher.accounting().balance());
}

#[test]
fn every_batch_is_accounted_for_also_if_it_is_dropped() {
    let batcher = batcher();
    let actor = Actor::join(&batcher, 5);
    let mut sequences = 0..;
    let mut next = || {
        for sequence in sequences.by_ref().take(CONFIG.unrolls) {
            assert_eq!(actor.send(&batcher, sequence), Some(Outcome::Taken));
        }
        batch_now(&batcher).unwrap()
    };
    batcher.trained(next());
    batcher.discard(next(), Reason::Stale);
    drop(next());
    let accounting = batcher.accounting();
    assert_eq!((accounting.trained, accounting.dropped.stale, accounting.dropped.lost_at_restart), (3, 3, 3));
    assert_eq!((accounting.produced, accounting.in_flight), (9, 0));
}
