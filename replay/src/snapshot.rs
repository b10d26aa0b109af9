//! The ledger in a checkpoint.

use std::collections::{BTreeMap, HashSet};

use comic_proto::MAX_SEQUENCE;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::accounting::{Accounting, AccountingByTask, Reason, TaskAccounting};
use crate::ledger::{Entry, Ledger};

/// One open account.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Account {
    /// The index of the actor.
    pub actor: u64,
    /// The actor process.
    pub incarnation: u64,
    /// The next sequence number: all lower numbers are accounted for.
    pub next_sequence: u64,
}

/// The ledger at one moment, as plain data.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LedgerSnapshot {
    /// The sums, with the unrolls in flight.
    pub accounting: Accounting,
    /// The sums of each task, by its name.
    #[serde(default)]
    pub tasks: BTreeMap<String, TaskAccounting>,
    /// The index of the next new actor.
    pub next_actor: u64,
    /// Open accounts, sorted by their last activity, the oldest first.
    pub accounts: Vec<Account>,
}

/// The reason why a snapshot cannot be restored.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum Error {
    /// The accounting does not balance.
    #[error("the accounting of the checkpoint does not balance: {accounting:?}")]
    Unbalanced {
        /// The stored sums.
        accounting: Accounting,
    },
    /// The accounting of a task does not balance, or the tasks together exceed the total.
    #[error("the accounting of {task} in the checkpoint does not balance: {accounting:?}")]
    UnbalancedTask {
        /// The task's name.
        task: String,
        /// The stored sums.
        accounting: TaskAccounting,
    },
    /// An index or an incarnation occurs twice, or an index was never assigned.
    #[error("account of actor {actor} in the checkpoint is repeated or out of range")]
    Account {
        /// The index of the actor.
        actor: u64,
    },
}

impl Ledger {
    /// The snapshot if unrolls of the tasks `waiting` wait for the trainer.
    pub(crate) fn snapshot(&self, waiting: impl Iterator<Item = u32>) -> LedgerSnapshot {
        let mut entries: Vec<_> = self.entries.iter().collect();
        entries.sort_by_key(|(_, entry)| entry.heard);
        let accounts = entries
            .into_iter()
            .map(|(actor, entry)| Account {
                actor: *actor,
                incarnation: entry.incarnation,
                next_sequence: entry.next_sequence,
            })
            .collect();
        let AccountingByTask { all: accounting, mut tasks } = self.accounting(waiting);
        tasks.extend(self.others.iter().map(|(task, accounting)| (task.clone(), *accounting)));
        LedgerSnapshot { accounting, tasks, next_actor: self.next_actor, accounts }
    }

    /// The ledger of a new learner epoch. The unrolls that were in flight are lost at restart.
    ///
    /// # Errors
    /// [`enum@Error`] if the snapshot is inconsistent.
    pub fn restore(snapshot: &LedgerSnapshot) -> Result<Self, Error> {
        let mut ledger = Self::new();
        let (mut incarnations, mut in_accounts) = (HashSet::new(), 0u64);
        for (account, heard) in snapshot.accounts.iter().zip(1..) {
            let Account { actor, incarnation, next_sequence } = *account;
            let entry = Entry { incarnation, next_sequence, heard };
            let repeated = ledger.entries.insert(actor, entry).is_some() || !incarnations.insert(incarnation);
            if repeated || actor >= snapshot.next_actor {
                return Err(Error::Account { actor });
            }
            ledger.actors.insert(incarnation, actor);
            ledger.clock = heard;
            in_accounts = in_accounts.saturating_add(next_sequence);
        }
        if snapshot.next_actor > MAX_SEQUENCE {
            return Err(Error::Account { actor: snapshot.next_actor });
        }
        let mut sums = snapshot.accounting;
        // The sum has closed accounts, too, so the open accounts are at most the sum.
        if !sums.balance() || in_accounts > sums.produced {
            return Err(Error::Unbalanced { accounting: snapshot.accounting });
        }
        sums.dropped.count(Reason::LostAtRestart, std::mem::take(&mut sums.in_flight));
        let parts = |accounting: &TaskAccounting| {
            [accounting.produced, accounting.trained, accounting.dropped.total(), accounting.in_flight]
        };
        let all = [sums.produced, sums.trained, snapshot.accounting.dropped.total(), snapshot.accounting.in_flight];
        let mut together = [0u64; 4];
        for (task, accounting) in &snapshot.tasks {
            // If an accounting balances, none of its sums has overflowed.
            let is_consistent = accounting.balance() && {
                together.iter_mut().zip(parts(accounting)).for_each(|(sum, part)| *sum = sum.saturating_add(part));
                together.iter().zip(all).all(|(sum, all)| *sum <= all)
            };
            if !is_consistent {
                return Err(Error::UnbalancedTask { task: task.clone(), accounting: *accounting });
            }
            let mut accounting = *accounting;
            accounting.dropped.count(Reason::LostAtRestart, std::mem::take(&mut accounting.in_flight));
            ledger.others.insert(task.clone(), accounting);
        }
        ledger.next_actor = snapshot.next_actor;
        ledger.sums = sums;
        Ok(ledger)
    }
}
