//! The ledger in a checkpoint.

use std::collections::{BTreeMap, HashMap, HashSet};

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
    /// Open accounts, sorted by their last activity, the oldest first; with several ranks those of each rank in turn.
    pub accounts: Vec<Account>,
    /// Whether some lower indices than `next_actor` were never assigned, because several ranks counted apart.
    #[serde(default)]
    pub sparse: bool,
}

impl LedgerSnapshot {
    /// The ledger of all ranks together, from that of each; `None` without a rank. A process whose answer to its first `Join` was lost
    /// may have an account at two ranks. It uses the newer one, so that has at least as many unrolls, and the other one is closed.
    pub fn of_ranks(ranks: impl IntoIterator<Item = Self>) -> Option<Self> {
        let mut all = Self::sum(ranks)?;
        let mut newest: HashMap<u64, Account> = HashMap::new();
        for account in &all.accounts {
            let known = newest.entry(account.incarnation).or_insert(*account);
            if (account.next_sequence, account.actor) > (known.next_sequence, known.actor) {
                *known = *account;
            }
        }
        all.accounts.retain(|account| newest.get(&account.incarnation) == Some(account));
        Some(all)
    }

    fn sum(ranks: impl IntoIterator<Item = Self>) -> Option<Self> {
        ranks.into_iter().reduce(|mut all, rank| {
            all.sparse = true;
            all.accounting += rank.accounting;
            for (task, accounting) in rank.tasks {
                *all.tasks.entry(task).or_default() += accounting;
            }
            all.next_actor = all.next_actor.max(rank.next_actor);
            all.accounts.extend(rank.accounts);
            all
        })
    }
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
        LedgerSnapshot { accounting, tasks, next_actor: self.next_actor, accounts, sparse: self.sparse }
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
        ledger.first_new = snapshot.next_actor;
        ledger.sparse = snapshot.sparse;
        ledger.sums = sums;
        Ok(ledger)
    }
}
