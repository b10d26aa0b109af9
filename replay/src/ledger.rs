//! Who sent what, and what became of it.

use std::collections::{BTreeMap, HashMap};

use comic_proto::MAX_SEQUENCE;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::tasks::{AccountingByTask, TaskAccounting, Tasks};

/// Sums over every unroll ever produced for this run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Accounting {
    /// Unrolls the sequence numbers speak of.
    pub produced: u64,
    /// Unrolls trained on.
    pub trained: u64,
    /// Unrolls that never will be, by reason.
    pub dropped: Dropped,
    /// Unrolls in a batch that is open, full, or being trained on.
    pub in_flight: u64,
    /// Messages that repeated an unroll already accounted for; not in the sum.
    pub duplicates: u64,
    /// Messages refused without an account to charge; not in the sum.
    pub unattributed: u64,
}

impl Accounting {
    /// Whether `produced = trained + dropped + in flight`.
    pub fn balance(&self) -> bool {
        self.dropped.add_to([self.trained, self.in_flight]) == Some(self.produced)
    }
}

/// Dropped unrolls by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dropped {
    /// Made with parameters older than the experiment allows.
    pub stale: u64,
    /// Failed validation.
    pub invalid: u64,
    /// Made in another epoch, or for a phase that is over.
    pub superseded: u64,
    /// Taken by, or sent to, a life of the learner that ended before it trained on them.
    pub lost_at_restart: u64,
}

impl Dropped {
    /// All reasons together.
    pub fn total(&self) -> u64 {
        self.stale + self.invalid + self.superseded + self.lost_at_restart
    }

    /// These and all reasons together, if a u64 can hold that.
    pub(crate) fn add_to(&self, others: [u64; 2]) -> Option<u64> {
        let reasons = [self.stale, self.invalid, self.superseded, self.lost_at_restart];
        others.into_iter().chain(reasons).try_fold(0u64, u64::checked_add)
    }

    pub(crate) fn count(&mut self, reason: Reason, unrolls: u64) {
        *match reason {
            Reason::Stale => &mut self.stale,
            Reason::Invalid => &mut self.invalid,
            Reason::Superseded => &mut self.superseded,
            Reason::LostAtRestart => &mut self.lost_at_restart,
        } += unrolls;
    }
}

/// Why an unroll is not trained on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Reason {
    /// See [`Dropped::stale`].
    Stale,
    /// See [`Dropped::invalid`].
    Invalid,
    /// See [`Dropped::superseded`].
    Superseded,
    /// See [`Dropped::lost_at_restart`].
    LostAtRestart,
}

/// What an actor gets by joining.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Joined {
    /// Its index.
    pub actor: u64,
    /// The first sequence number its account does not speak of.
    pub next_sequence: u64,
}

/// Why an actor may not join.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum JoinError {
    /// Its account was closed to make room for others.
    #[error(
        "the account of actor {actor}, incarnation {incarnation:016x}, was closed after a long silence: start the actor again"
    )]
    Closed {
        /// The index it had.
        actor: u64,
        /// Who asked.
        incarnation: u64,
    },
}

/// One incarnation's account.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Entry {
    pub(crate) incarnation: u64,
    pub(crate) next_sequence: u64,
    /// When it was last heard of, on the ledger's own clock.
    pub(crate) heard: u64,
}

/// What the accounts say about a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Sighting {
    /// Not accounted for yet.
    New,
    /// Accounted for.
    Duplicate,
    /// No number an actor can have reached.
    Broken,
    /// Nobody's.
    Unknown,
}

/// Every actor's account, and the sums. See the crate's rules.
#[derive(Clone, Debug)]
pub struct Ledger {
    pub(crate) entries: HashMap<u64, Entry>,
    pub(crate) actors: HashMap<u64, u64>,
    pub(crate) next_actor: u64,
    pub(crate) clock: u64,
    capacity: usize,
    /// In flight is what the trainer holds; what waits for it is counted in the batcher's buffers.
    pub(crate) sums: Accounting,
    tasks: Tasks,
    /// The accounting of tasks that this life does not have, for one that does.
    pub(crate) others: BTreeMap<String, TaskAccounting>,
}

impl Default for Ledger {
    fn default() -> Self {
        Self::new()
    }
}

impl Ledger {
    /// Accounts that can be open at once: above any number of actors that can be connected, a few MB of memory.
    pub const CAPACITY: usize = 65_536;

    /// The ledger of a new run.
    pub fn new() -> Self {
        Self::with_capacity(Self::CAPACITY)
    }

    /// A ledger with room for this many open accounts, at least one.
    pub fn with_capacity(capacity: usize) -> Self {
        Self {
            entries: HashMap::new(),
            actors: HashMap::new(),
            next_actor: 0,
            clock: 0,
            capacity: capacity.max(1),
            sums: Accounting::default(),
            tasks: Tasks::default(),
            others: BTreeMap::new(),
        }
    }

    /// Keeps the accounting of each of these tasks too, in the order of the indices in the unrolls' headers. A restored
    /// ledger continues the accounting of tasks of the same name.
    #[must_use]
    pub fn with_tasks(mut self, tasks: impl IntoIterator<Item = String>) -> Self {
        let mut known = std::mem::take(&mut self.others);
        known.extend(std::mem::take(&mut self.tasks).by_name());
        self.tasks = Tasks::new(tasks, &mut known);
        self.others = known;
        self
    }

    /// Opens an account, or finds the one this incarnation has. `claimed` is the index the actor says it had.
    ///
    /// # Errors
    /// [`JoinError::Closed`] when it had an account that was closed.
    pub fn join(&mut self, incarnation: u64, claimed: Option<u64>) -> Result<Joined, JoinError> {
        self.clock += 1;
        if let Some(actor) = self.actors.get(&incarnation)
            && let Some(entry) = self.entries.get_mut(actor)
        {
            entry.heard = self.clock;
            return Ok(Joined { actor: *actor, next_sequence: entry.next_sequence });
        }
        // Every index below `next_actor` was given out in this run. One without an entry was closed. One that belongs
        // to somebody else was given out anew after a restart that did not know the claimant; that one starts afresh,
        // and so does a claimant of an index this life of the learner has not reached.
        if let Some(actor) = claimed.filter(|actor| *actor < self.next_actor && !self.entries.contains_key(actor)) {
            return Err(JoinError::Closed { actor, incarnation });
        }
        if self.entries.len() >= self.capacity {
            self.close_least_recent();
        }
        let actor = self.next_actor;
        self.next_actor += 1;
        self.entries.insert(actor, Entry { incarnation, next_sequence: 0, heard: self.clock });
        self.actors.insert(incarnation, actor);
        Ok(Joined { actor, next_sequence: 0 })
    }

    /// Accounts for every number below `sequence`, all of which were acknowledged to the actor: those that its account does not
    /// speak of were lost with the life of the learner that did. Says which number comes next.
    pub fn catch_up(&mut self, actor: u64, sequence: u64) -> u64 {
        let Some(entry) = self.entries.get_mut(&actor) else { return 0 };
        let lost = sequence.min(MAX_SEQUENCE).saturating_sub(entry.next_sequence);
        if let Some(produced) = self.sums.produced.checked_add(lost) {
            entry.next_sequence += lost;
            self.sums.produced = produced;
            self.sums.dropped.count(Reason::LostAtRestart, lost);
        }
        entry.next_sequence
    }

    fn close_least_recent(&mut self) {
        let least = self.entries.iter().min_by_key(|(_, entry)| entry.heard).map(|(actor, _)| *actor);
        if let Some(entry) = least.and_then(|actor| self.entries.remove(&actor)) {
            self.actors.remove(&entry.incarnation);
        }
    }

    /// Open accounts.
    pub fn open_accounts(&self) -> usize {
        self.entries.len()
    }

    pub(crate) fn sight(&self, actor: u64, incarnation: u64, sequence: u64) -> Sighting {
        match self.entries.get(&actor) {
            Some(entry) if entry.incarnation != incarnation => Sighting::Unknown,
            Some(_) if sequence >= MAX_SEQUENCE => Sighting::Broken,
            Some(entry) if sequence < entry.next_sequence => Sighting::Duplicate,
            Some(_) => Sighting::New,
            None => Sighting::Unknown,
        }
    }

    /// Accounts for a number that [`sight`](Self::sight) called new. False, and nothing changed, if it is not, or if
    /// the sum of all numbers would leave its range (then no other sum can). `clip` is the unroll's first, if it is known.
    pub(crate) fn record(&mut self, actor: u64, sequence: u64, task: Option<u32>) -> bool {
        let Some(entry) = self.entries.get_mut(&actor) else { return false };
        let Some(skipped) = sequence.checked_sub(entry.next_sequence) else { return false };
        let Some(produced) = self.sums.produced.checked_add(skipped).and_then(|sum| sum.checked_add(1)) else {
            return false;
        };
        self.clock += 1;
        entry.heard = self.clock;
        entry.next_sequence = sequence + 1;
        self.sums.produced = produced;
        self.sums.dropped.count(Reason::LostAtRestart, skipped);
        if let Some(accounting) = task.and_then(|task| self.tasks.of(task)) {
            accounting.produced += 1;
        }
        true
    }

    /// Counts a message without an account to charge. A checkpoint may claim any number of them.
    pub(crate) fn refuse(&mut self) {
        self.sums.unattributed = self.sums.unattributed.saturating_add(1);
    }

    /// Counts a message that repeats an unroll.
    pub(crate) fn repeat(&mut self) {
        self.sums.duplicates = self.sums.duplicates.saturating_add(1);
    }

    /// Counts unrolls of these tasks as being with the trainer.
    pub(crate) fn hand_out(&mut self, tasks: impl Iterator<Item = u32>) {
        for task in tasks {
            self.sums.in_flight += 1;
            self.tasks.of(task).into_iter().for_each(|accounting| accounting.in_flight += 1);
        }
    }

    /// Accounting one that was handed out as trained on, or as dropped for a reason.
    pub(crate) fn take_back(&mut self, task: u32, end: Option<Reason>) {
        self.sums.in_flight -= 1;
        self.tasks.of(task).into_iter().for_each(|accounting| accounting.in_flight -= 1);
        self.end(Some(task), end);
    }

    /// Accounting one unroll, of this task, as trained on, or as dropped for a reason.
    pub(crate) fn end(&mut self, task: Option<u32>, end: Option<Reason>) {
        let accounting = task.and_then(|task| self.tasks.of(task));
        match end {
            None => {
                self.sums.trained += 1;
                accounting.into_iter().for_each(|accounting| accounting.trained += 1);
            }
            Some(reason) => {
                self.sums.dropped.count(reason, 1);
                accounting.into_iter().for_each(|accounting| accounting.dropped.count(reason, 1));
            }
        }
    }

    /// The accounting, with unrolls of these tasks waiting for the trainer.
    pub(crate) fn accounting(&self, waiting: impl Iterator<Item = u32>) -> AccountingByTask {
        let (mut all, mut tasks) = (self.sums, self.tasks.clone());
        for task in waiting {
            all.in_flight += 1;
            tasks.of(task).into_iter().for_each(|accounting| accounting.in_flight += 1);
        }
        AccountingByTask { all, tasks: tasks.by_name() }
    }
}
