//! Accounts of joining actors: identity and capacity.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use comic_replay::{JoinError, Joined, Ledger};
use proptest::prelude::*;

#[test]
fn a_reconnecting_process_keeps_its_index_and_a_new_process_gets_another() {
    let mut ledger = Ledger::new();
    let first = ledger.join(70, None).unwrap();
    assert_eq!(first, Joined { actor: 0, next_sequence: 0 });
    assert_eq!(ledger.join(71, None).unwrap().actor, 1);
    assert_eq!(ledger.join(70, Some(0)).unwrap(), first);
    assert_eq!(ledger.join(70, None).unwrap(), first, "the incarnation alone identifies the actor");
    assert_eq!(ledger.join(72, Some(0)).unwrap().actor, 2, "a claimed index of another process is not given");
    assert_eq!(
        ledger.join(73, Some(u64::MAX)).unwrap().actor,
        3,
        "a claimed index that was never assigned is not given"
    );
}

#[test]
fn beyond_the_capacity_the_least_recently_active_account_is_closed_for_ever() {
    let mut ledger = Ledger::with_capacity(2);
    let silent = ledger.join(70, None).unwrap().actor;
    let busy = ledger.join(71, None).unwrap().actor;
    ledger.join(70, None).unwrap();
    ledger.join(71, None).unwrap();
    ledger.join(72, None).unwrap();
    assert_eq!(ledger.open_accounts(), 2);
    assert_eq!(ledger.join(71, Some(busy)).unwrap().actor, busy);
    assert_eq!(ledger.join(70, Some(silent)), Err(JoinError::Closed { actor: silent, incarnation: 70 }));
}

proptest! {
    #[test]
    fn no_index_belongs_to_two_processes(
        joins in prop::collection::vec((0u64..20, prop::option::of(0u64..20)), 1..200),
        capacity in 1usize..8,
    ) {
        let mut ledger = Ledger::with_capacity(capacity);
        let mut owners = std::collections::HashMap::new();
        for (incarnation, claimed) in joins {
            if let Ok(joined) = ledger.join(incarnation, claimed) {
                prop_assert_eq!(*owners.entry(joined.actor).or_insert(incarnation), incarnation);
            }
            prop_assert!(ledger.open_accounts() <= capacity);
        }
    }
}
