//! The ledgers of several ranks are together the ledger of the run.

#![allow(clippy::unwrap_used)]

mod common;

use std::collections::HashSet;

use comic_replay::{Account, Accounting, Batcher, Dropped, JoinError, Ledger, LedgerSnapshot, home};
use proptest::prelude::*;

/// A ledger in which these actors have sent so many unrolls. All were trained on, but for `in_flight` of them.
fn snapshot(sent: &[u64], closed: u64, in_flight: u64) -> LedgerSnapshot {
    let accounts = sent.iter().zip(0..).map(|(next_sequence, actor)| Account {
        actor: 3 * actor,
        incarnation: 1000 + actor,
        next_sequence: *next_sequence,
    });
    let produced = sent.iter().sum::<u64>() + closed;
    let in_flight = in_flight.min(produced);
    let accounting = Accounting { produced, trained: produced - in_flight, in_flight, ..Accounting::default() };
    LedgerSnapshot {
        accounting,
        tasks: [].into(),
        next_actor: 3 * sent.len() as u64,
        accounts: accounts.collect(),
        sparse: false,
    }
}

/// The ledger of each of so many ranks.
fn parts(whole: &LedgerSnapshot, ranks: usize) -> Vec<Ledger> {
    (0..ranks).map(|rank| Ledger::restore(whole).unwrap().part_of(rank, ranks)).collect()
}

/// The ledger as a batcher saves it.
fn saved(ledger: Ledger) -> LedgerSnapshot {
    Batcher::new(common::layout(), common::CONFIG, common::PHASE, ledger).snapshot()
}

proptest! {
    #[test]
    fn a_run_is_divided_among_any_number_of_ranks_and_put_together_again(
        sent in prop::collection::vec(0u64..50, 0..8),
        closed in 0u64..9,
        in_flight in 0u64..9,
        ranks in 1usize..5,
    ) {
        let whole = snapshot(&sent, closed, in_flight);
        let together = LedgerSnapshot::of_ranks(parts(&whole, ranks).into_iter().map(saved)).unwrap();
        let Accounting { produced, trained, in_flight: lost, .. } = whole.accounting;
        let dropped = Dropped { lost_at_restart: lost, ..Dropped::default() };
        prop_assert_eq!(together.accounting, Accounting { produced, trained, dropped, ..Accounting::default() });
        let sorted = |snapshot: &LedgerSnapshot| {
            let mut accounts = snapshot.accounts.clone();
            accounts.sort_by_key(|account| account.actor);
            accounts
        };
        prop_assert_eq!(sorted(&together), sorted(&whole));
        prop_assert!(Ledger::restore(&together).is_ok());
    }

    #[test]
    fn no_two_ranks_have_an_actor_of_one_index(
        sent in prop::collection::vec(0u64..50, 0..8),
        ranks in 1usize..5,
        new in prop::collection::vec(0usize..5, 1..20),
    ) {
        let whole = snapshot(&sent, 0, 0);
        let mut ledgers = parts(&whole, ranks);
        let mut indices: HashSet<u64> = whole.accounts.iter().map(|account| account.actor).collect();
        for (incarnation, rank) in new.into_iter().enumerate() {
            let rank = rank % ranks;
            let joined = ledgers[rank].join(incarnation as u64, None).unwrap();
            prop_assert_eq!(home(joined.actor, ranks), rank);
            prop_assert!(indices.insert(joined.actor), "{} has two actors", joined.actor);
        }
    }

    #[test]
    fn an_actor_keeps_its_account_when_the_number_of_ranks_changes(
        sent in prop::collection::vec(0u64..50, 1..8),
        ranks in 1usize..5,
    ) {
        let whole = snapshot(&sent, 0, 0);
        for account in &whole.accounts {
            let mut own = parts(&whole, ranks).swap_remove(home(account.actor, ranks));
            let joined = own.join(account.incarnation, Some(account.actor)).unwrap();
            prop_assert_eq!((joined.actor, joined.next_sequence), (account.actor, account.next_sequence));
        }
    }
}

#[test]
fn a_process_with_an_account_at_two_ranks_keeps_the_one_that_it_uses() {
    let (one, mut other) = (snapshot(&[0, 7], 0, 0), snapshot(&[0, 9], 0, 0));
    other.accounts.iter_mut().for_each(|account| account.actor += 1);
    let whole = LedgerSnapshot::of_ranks([one, other]).unwrap();
    let sequences: Vec<u64> = whole.accounts.iter().map(|account| account.next_sequence).collect();
    assert_eq!(sequences, [0, 9]);
    assert_eq!(whole.accounting.produced, 16, "what the closed account counted stays counted");
    Ledger::restore(&whole).unwrap();
}

#[test]
fn an_account_that_one_of_several_ranks_closed_is_not_opened_again() {
    let mut own = Ledger::with_capacity(2).part_of(1, 2);
    let first = own.join(70, None).unwrap();
    for incarnation in 71..73 {
        own.join(incarnation, None).unwrap();
    }
    assert_eq!(own.join(70, Some(first.actor)), Err(JoinError::Closed { actor: first.actor, incarnation: 70 }));
}

#[test]
fn an_actor_that_joined_after_the_checkpoint_gets_a_new_account_from_any_number_of_ranks() {
    // Rank 1 has counted further than rank 0 when the checkpoint is made; then an actor joins rank 0.
    let mut ledgers = parts(&snapshot(&[], 0, 0), 2);
    for incarnation in 0..3 {
        ledgers[1].join(incarnation, None).unwrap();
    }
    let checkpoint = LedgerSnapshot::of_ranks(ledgers.iter().cloned().map(saved)).unwrap();
    let late = ledgers[0].join(9, None).unwrap();
    for ranks in 1..4 {
        let mut own = parts(&checkpoint, ranks).swap_remove(home(late.actor, ranks));
        let again = own.join(9, Some(late.actor)).unwrap();
        assert_eq!(again.next_sequence, 0, "{ranks} ranks");
        assert!(again.actor >= checkpoint.next_actor, "{ranks} ranks");
    }
}
