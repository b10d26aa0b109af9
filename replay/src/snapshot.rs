//! Books and accounts in a checkpoint.

use std::collections::HashSet;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::ledger::{Books, Entry, Ledger, Reason};

/// One open account.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Account {
    /// The actor's index.
    pub actor: u64,
    /// The process that has it.
    pub incarnation: u64,
    /// The first sequence number not accounted for.
    pub next_sequence: u64,
}

/// The ledger at one moment, as plain data.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Snapshot {
    /// The sums, what was in flight included.
    pub books: Books,
    /// The index the next new actor gets.
    pub next_actor: u64,
    /// Open accounts, the one heard of least recently first.
    pub accounts: Vec<Account>,
}

/// Why a snapshot cannot be restored.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum Error {
    /// The law does not hold.
    #[error("books of the checkpoint do not balance: {books:?}")]
    Unbalanced {
        /// As stored.
        books: Books,
    },
    /// An index or an incarnation stands there twice, or an index that was never given out.
    #[error("account of actor {actor} in the checkpoint is repeated or out of range")]
    Account {
        /// The index.
        actor: u64,
    },
}

impl Ledger {
    pub(crate) fn snapshot(&self, in_flight: u64) -> Snapshot {
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
        Snapshot { books: Books { in_flight, ..self.sums }, next_actor: self.next_actor, accounts }
    }

    /// The ledger a new life of the learner starts with: what was in flight at the snapshot is lost at restart.
    ///
    /// # Errors
    /// [`Error`] when the snapshot contradicts itself.
    pub fn restore(snapshot: &Snapshot) -> Result<Self, Error> {
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
        let mut sums = snapshot.books;
        // Closed accounts are in the sum too, so the open ones can only fall short of it.
        if !sums.balance() || in_accounts > sums.produced {
            return Err(Error::Unbalanced { books: snapshot.books });
        }
        sums.dropped.count(Reason::LostAtRestart, std::mem::take(&mut sums.in_flight));
        ledger.next_actor = snapshot.next_actor;
        ledger.sums = sums;
        Ok(ledger)
    }
}
