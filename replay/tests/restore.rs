//! A learner that restarts continues the accounting and the accounts of its checkpoint.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use comic_replay::{
    Accounting, Batcher, Dropped, Error, Joined, Ledger, LedgerSnapshot, Outcome, Phase, TaskAccounting,
};
use common::{Actor, CONFIG, PHASE, batch_now, batcher, insert_now, layout, with_tasks};

/// The batcher of the next learner epoch, restored from the text of a checkpoint.
fn restarted(snapshot: &LedgerSnapshot) -> Batcher {
    let stored = serde_json::to_string(snapshot).unwrap();
    let ledger = Ledger::restore(&serde_json::from_str(&stored).unwrap()).unwrap();
    Batcher::new(layout(), CONFIG, Phase { epoch: PHASE.epoch + 1, ..PHASE }, with_tasks(ledger))
}

#[test]
fn unrolls_in_flight_at_the_checkpoint_are_lost_and_never_trained_on() {
    let before = batcher();
    let actor = Actor::join(&before, 5);
    for sequence in 0..5 {
        assert_eq!(actor.send(&before, sequence), Some(Outcome::Taken));
    }
    before.trained(batch_now(&before).unwrap());
    let snapshot = before.snapshot();
    assert_eq!((snapshot.accounting.trained, snapshot.accounting.in_flight), (3, 2));

    let after = restarted(&snapshot);
    let lost = Dropped { lost_at_restart: 2, ..Dropped::default() };
    assert_eq!(after.accounting(), Accounting { produced: 5, trained: 3, dropped: lost, ..Accounting::default() });
    let mut resent = actor.header(4);
    resent.learner_epoch = PHASE.epoch + 1;
    assert_eq!(insert_now(&after, &resent), Some(Outcome::Duplicate));
}

#[test]
fn every_task_continues_its_own_accounting_and_a_new_task_begins_at_zero() {
    let before = batcher();
    let actor = Actor::join(&before, 5);
    for sequence in 7..12 {
        assert_eq!(actor.send(&before, sequence), Some(Outcome::Taken));
    }
    before.trained(batch_now(&before).unwrap());
    let stored = serde_json::to_string(&before.snapshot()).unwrap();

    let ledger = Ledger::restore(&serde_json::from_str(&stored).unwrap()).unwrap();
    let tasks = ["ball-catch", "get-up"].map(String::from);
    let away = Batcher::new(layout(), CONFIG, PHASE, ledger.with_tasks(tasks));
    let after = away.accounting_by_task().tasks;
    let lost = Dropped { lost_at_restart: 2, ..Dropped::default() };
    assert_eq!(after["get-up"], TaskAccounting { produced: 2, dropped: lost, ..TaskAccounting::default() });
    assert_eq!(after["ball-catch"], TaskAccounting::default());
    assert_eq!(after.len(), 2);
    // A later epoch continues the accounting of a task that one epoch does not have.
    let back = with_tasks(Ledger::restore(&away.snapshot()).unwrap());
    let tracking = Batcher::new(layout(), CONFIG, PHASE, back).accounting_by_task().tasks["tracking"];
    assert_eq!(tracking, TaskAccounting { produced: 3, trained: 3, ..TaskAccounting::default() });
}

#[test]
fn a_snapshot_without_the_accounting_of_tasks_is_restored() {
    let before = batcher();
    let mut stored = serde_json::to_value(before.snapshot()).unwrap();
    stored.as_object_mut().unwrap().remove("tasks");
    assert!(Ledger::restore(&serde_json::from_value(stored).unwrap()).is_ok());
}

/// An actor with incarnation 5, the batcher of the next learner epoch, and the result of joining it. Unrolls 0 to 2
/// were accepted before the crash; the last two came after the checkpoint and are lost.
fn rejoined_after_a_crash() -> (Actor, Batcher, Joined) {
    let before = batcher();
    let actor = Actor::join(&before, 5);
    assert_eq!(actor.send(&before, 0), Some(Outcome::Taken));
    let snapshot = before.snapshot();
    assert_eq!(actor.send(&before, 1), Some(Outcome::Taken));
    assert_eq!(actor.send(&before, 2), Some(Outcome::Taken));
    let after = restarted(&snapshot);
    let joined = after.join(5, Some(actor.actor)).unwrap();
    (actor, after, joined)
}

#[test]
fn a_reconnecting_actor_keeps_its_account_and_skipped_numbers_are_lost() {
    let (actor, after, joined) = rejoined_after_a_crash();
    assert_eq!((joined.actor, joined.next_sequence), (actor.actor, 1));
    let of_tasks = after.accounting_by_task().tasks;
    assert_eq!(actor.send(&after, 3), Some(Outcome::Superseded), "resent, but made in the epoch before");
    assert_eq!(after.accounting_by_task().tasks, of_tasks, "an unroll of another epoch counts for no task");
    let mut fresh = actor.header(4);
    fresh.learner_epoch = PHASE.epoch + 1;
    assert_eq!(insert_now(&after, &fresh), Some(Outcome::Taken));
    let dropped = Dropped { lost_at_restart: 3, superseded: 1, ..Dropped::default() };
    assert_eq!(after.accounting(), Accounting { produced: 5, dropped, in_flight: 1, ..Accounting::default() });
}

#[test]
fn acknowledged_numbers_that_the_checkpoint_does_not_have_are_lost() {
    let (actor, after, joined) = rejoined_after_a_crash();
    assert_eq!(after.catch_up(joined.actor, 3), Some(3));
    assert_eq!(after.catch_up(joined.actor, 2), Some(3), "an account never moves back");
    let dropped = Dropped { lost_at_restart: 3, ..Dropped::default() };
    assert_eq!(after.accounting(), Accounting { produced: 3, dropped, ..Accounting::default() });
    assert_eq!(after.catch_up(99, 3), None, "numbers without an account are not counted");
    assert_eq!(after.accounting().produced, 3);
    assert_eq!(actor.send(&after, 2), Some(Outcome::Duplicate), "it is never trained on again");
}

#[test]
fn an_actor_without_an_account_in_the_checkpoint_gets_a_new_one() {
    let before = batcher();
    let snapshot = before.snapshot();
    let late = Actor::join(&before, 5);
    let after = restarted(&snapshot);
    let newcomer = after.join(6, None).unwrap();
    assert_eq!(newcomer.actor, late.actor, "the index is assigned again");
    let joined = after.join(5, Some(late.actor)).unwrap();
    assert_ne!(joined.actor, newcomer.actor);
    assert_eq!(joined.next_sequence, 0);
}

#[test]
fn the_number_of_refusals_in_a_snapshot_may_be_the_largest_number() {
    let mut snapshot = batcher().snapshot();
    (snapshot.accounting.duplicates, snapshot.accounting.unattributed) = (u64::MAX, u64::MAX);
    let after = restarted(&snapshot);
    after.refuse_unattributed();
    assert_eq!(after.accounting().unattributed, u64::MAX);
}

#[test]
fn an_inconsistent_snapshot_is_refused() {
    let before = batcher();
    let actor = Actor::join(&before, 5);
    assert_eq!(actor.send(&before, 0), Some(Outcome::Taken));
    let good = before.snapshot();
    let refusal = |change: fn(&mut LedgerSnapshot)| {
        let mut snapshot = good.clone();
        change(&mut snapshot);
        Ledger::restore(&snapshot).err()
    };
    assert_eq!(refusal(|_| {}), None);
    assert!(matches!(refusal(|snapshot| snapshot.accounting.trained += 1), Some(Error::Unbalanced { .. })));
    assert!(matches!(refusal(|snapshot| snapshot.accounting.dropped.stale = u64::MAX), Some(Error::Unbalanced { .. })));
    assert!(matches!(refusal(|snapshot| snapshot.accounts[0].next_sequence = 2), Some(Error::Unbalanced { .. })));
    let repeated = |snapshot: &mut LedgerSnapshot| snapshot.accounts.push(snapshot.accounts[0]);
    assert_eq!(refusal(repeated), Some(Error::Account { actor: 0 }));
    assert_eq!(refusal(|snapshot| snapshot.next_actor = 0), Some(Error::Account { actor: 0 }));
    assert_eq!(refusal(|snapshot| snapshot.next_actor = u64::MAX), Some(Error::Account { actor: u64::MAX }));
    let unbalanced = |snapshot: &mut LedgerSnapshot| snapshot.tasks.get_mut("tracking").unwrap().trained += 1;
    assert!(matches!(refusal(unbalanced), Some(Error::UnbalancedTask { .. })));
    let too_many = |snapshot: &mut LedgerSnapshot| {
        let own = TaskAccounting { produced: 1, trained: 1, ..TaskAccounting::default() };
        snapshot.tasks.insert("get-up".into(), own);
    };
    assert!(matches!(refusal(too_many), Some(Error::UnbalancedTask { .. })), "more than the total");
    let trained = |snapshot: &mut LedgerSnapshot| {
        let own = snapshot.tasks.get_mut("tracking").unwrap();
        (own.trained, own.in_flight) = (own.in_flight, 0);
    };
    assert!(
        matches!(refusal(trained), Some(Error::UnbalancedTask { .. })),
        "the task has more trained unrolls than the total"
    );
}
