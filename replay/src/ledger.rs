//! The accounts of the actors, and the sums.

use std::collections::{BTreeMap, HashMap};

use comic_proto::MAX_SEQUENCE;
use thiserror::Error;

use crate::accounting::{Accounting, AccountingByTask, Reason, TaskAccounting};
use crate::tasks::Tasks;

/// Most unrolls of one actor that the learner can have lost with an earlier learner epoch. An actor makes at most some hundred a
/// second, and this many in half a day; nobody resumes a run from so far back without starting its actors again. A larger
/// number is a lie, and the sums would soon be at their end.
pub const MOST_LOST: u64 = 1 << 24;

/// The account of an actor that joined.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Joined {
    /// The index of the actor.
    pub actor: u64,
    /// The next sequence number: all lower numbers are accounted for.
    pub next_sequence: u64,
}

/// The reason why an actor may not join.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum JoinError {
    /// Its account was closed to make room for other accounts.
    #[error(
        "the account of actor {actor}, incarnation {incarnation:016x}, was closed because it was inactive for long: start the actor again"
    )]
    Closed {
        /// The index of the closed account.
        actor: u64,
        /// The incarnation that joins.
        incarnation: u64,
    },
}

/// The rank that an actor belongs to, of this number of ranks, from its index alone: so every rank can tell, also after a restart with
/// another number of ranks.
pub fn home(actor: u64, ranks: usize) -> usize {
    (actor % ranks.max(1) as u64) as usize
}

/// The account of one incarnation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Entry {
    pub(crate) incarnation: u64,
    pub(crate) next_sequence: u64,
    /// Time of its last activity, on the ledger's clock, which counts events.
    pub(crate) heard: u64,
}

/// The status of a sequence number in the accounts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SequenceStatus {
    /// The number is new.
    New,
    /// The number is accounted for.
    Duplicate,
    /// No actor can have reached the number.
    OutOfRange,
    /// Actor and incarnation have no account.
    Unknown,
}

/// The account of every actor, and the sums. The documentation of the crate has the rules.
#[derive(Clone, Debug)]
pub struct Ledger {
    pub(crate) entries: HashMap<u64, Entry>,
    pub(crate) actors: HashMap<u64, u64>,
    pub(crate) next_actor: u64,
    /// Distance between the indices of two new actors.
    stride: u64,
    /// The first index that this rank gave out in this learner epoch.
    pub(crate) first_new: u64,
    /// See [`LedgerSnapshot`](crate::LedgerSnapshot).
    pub(crate) sparse: bool,
    pub(crate) clock: u64,
    capacity: usize,
    /// Here, `in_flight` has only the unrolls at the trainer. The batcher counts the waiting unrolls in its buffers.
    pub(crate) sums: Accounting,
    tasks: Tasks,
    /// The accounting of tasks that this learner epoch does not have. A later epoch may have them again.
    pub(crate) others: BTreeMap<String, TaskAccounting>,
}

impl Default for Ledger {
    fn default() -> Self {
        Self::new()
    }
}

impl Ledger {
    /// Greatest number of open accounts. It is above the number of actors that can be connected, and needs a few MB.
    pub const CAPACITY: usize = 65_536;

    /// The ledger of a new run.
    pub fn new() -> Self {
        Self::with_capacity(Self::CAPACITY)
    }

    /// A ledger with this greatest number of open accounts, at least 1.
    pub fn with_capacity(capacity: usize) -> Self {
        Self {
            entries: HashMap::new(),
            actors: HashMap::new(),
            next_actor: 0,
            stride: 1,
            first_new: 0,
            sparse: false,
            clock: 0,
            capacity: capacity.max(1),
            sums: Accounting::default(),
            tasks: Tasks::default(),
            others: BTreeMap::new(),
        }
    }

    /// Adds the accounting of each of these tasks. Their order is that of the task indices in the headers of unrolls. A
    /// restored ledger continues the accounting of tasks with the same name.
    #[must_use]
    pub fn with_tasks(mut self, tasks: impl IntoIterator<Item = String>) -> Self {
        let mut known = std::mem::take(&mut self.others);
        known.extend(std::mem::take(&mut self.tasks).by_name());
        self.tasks = Tasks::new(tasks, &mut known);
        self.others = known;
        self
    }

    /// The part of this ledger that one of several ranks keeps: the accounts of the actors that [`home`] gives it, and new indices of
    /// its own. Rank 0 keeps the sums so far, so the sums of all ranks together are those of the run.
    #[must_use]
    pub fn part_of(mut self, rank: usize, ranks: usize) -> Self {
        let is_own = |actor: u64| home(actor, ranks) == rank;
        self.entries.retain(|actor, _| is_own(*actor));
        self.actors.retain(|_, actor| is_own(*actor));
        self.stride = ranks.max(1) as u64;
        self.sparse |= ranks > 1;
        while !is_own(self.next_actor) {
            self.next_actor += 1;
        }
        self.first_new = self.next_actor;
        if rank > 0 {
            self.sums = Accounting::default();
            self.tasks = Tasks::default();
            self.others.clear();
        }
        self
    }

    /// Opens an account, or finds the account of this incarnation. `claimed` is the index that the actor had before.
    ///
    /// # Errors
    /// [`JoinError::Closed`] if its account was closed.
    pub fn join(&mut self, incarnation: u64, claimed: Option<u64>) -> Result<Joined, JoinError> {
        self.clock += 1;
        if let Some(actor) = self.actors.get(&incarnation)
            && let Some(entry) = self.entries.get_mut(actor)
        {
            entry.heard = self.clock;
            return Ok(Joined { actor: *actor, next_sequence: entry.next_sequence });
        }
        // Every index below `next_actor` was assigned in this run, unless several ranks counted apart: then this is known of those
        // that this rank has given out itself. So such an index without an entry was closed. An index of another incarnation was
        // assigned again after a restart from a checkpoint without this actor; then the actor gets a new account. An actor with an
        // index that is not assigned yet gets a new account, too.
        let known = |actor: &u64| *actor < self.next_actor && (!self.sparse || self.gave_out(*actor));
        if let Some(actor) = claimed.filter(|actor| known(actor) && !self.entries.contains_key(actor)) {
            return Err(JoinError::Closed { actor, incarnation });
        }
        if self.entries.len() >= self.capacity {
            self.close_least_recent();
        }
        let actor = self.next_actor;
        self.next_actor += self.stride;
        self.entries.insert(actor, Entry { incarnation, next_sequence: 0, heard: self.clock });
        self.actors.insert(incarnation, actor);
        Ok(Joined { actor, next_sequence: 0 })
    }

    /// Whether this rank gave an actor this index in this learner epoch.
    fn gave_out(&self, actor: u64) -> bool {
        (self.first_new..self.next_actor).contains(&actor) && (actor - self.first_new).is_multiple_of(self.stride)
    }

    /// Accounts for all numbers below `sequence`, which were acknowledged to the actor. Numbers that the account does
    /// not have were lost with an earlier learner epoch. Returns the next sequence number. `None`, and nothing is changed,
    /// without an account, or if so many cannot have been lost.
    pub fn catch_up(&mut self, actor: u64, sequence: u64) -> Option<u64> {
        let entry = self.entries.get_mut(&actor)?;
        let lost = sequence.saturating_sub(entry.next_sequence);
        let produced = self.sums.produced.checked_add(lost).filter(|_| lost <= MOST_LOST)?;
        entry.next_sequence += lost;
        self.sums.produced = produced;
        self.sums.dropped.count(Reason::LostAtRestart, lost);
        Some(entry.next_sequence)
    }

    /// Closes the account with the oldest activity.
    fn close_least_recent(&mut self) {
        let least = self.entries.iter().min_by_key(|(_, entry)| entry.heard).map(|(actor, _)| *actor);
        if let Some(entry) = least.and_then(|actor| self.entries.remove(&actor)) {
            self.actors.remove(&entry.incarnation);
        }
    }

    /// Number of open accounts.
    pub fn open_accounts(&self) -> usize {
        self.entries.len()
    }

    /// The status of a sequence number of this actor and incarnation.
    pub(crate) fn status(&self, actor: u64, incarnation: u64, sequence: u64) -> SequenceStatus {
        match self.entries.get(&actor) {
            Some(entry) if entry.incarnation != incarnation => SequenceStatus::Unknown,
            Some(_) if sequence >= MAX_SEQUENCE => SequenceStatus::OutOfRange,
            Some(entry) if sequence < entry.next_sequence => SequenceStatus::Duplicate,
            Some(entry) if sequence - entry.next_sequence > MOST_LOST => SequenceStatus::OutOfRange,
            Some(_) => SequenceStatus::New,
            None => SequenceStatus::Unknown,
        }
    }

    /// Accounts for a number that is new according to [`status`](Self::status). `task` is the task of the unroll, if it
    /// is known. Returns false and changes nothing if the number is not new, or if the sum of all numbers would
    /// overflow; so no other sum can overflow.
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

    /// Counts a message without an account. The sum saturates, because a checkpoint may have any number.
    pub(crate) fn refuse(&mut self) {
        self.sums.unattributed = self.sums.unattributed.saturating_add(1);
    }

    /// Counts a duplicate. The sum saturates, because a checkpoint may have any number.
    pub(crate) fn repeat(&mut self) {
        self.sums.duplicates = self.sums.duplicates.saturating_add(1);
    }

    /// Counts unrolls of these tasks as being at the trainer.
    pub(crate) fn hand_out(&mut self, tasks: impl Iterator<Item = u32>) {
        for task in tasks {
            self.sums.in_flight += 1;
            self.tasks.of(task).into_iter().for_each(|accounting| accounting.in_flight += 1);
        }
    }

    /// Accounts for an unroll at the trainer as dropped for this reason, or without a reason as trained on.
    pub(crate) fn take_back(&mut self, task: u32, dropped: Option<Reason>) {
        self.sums.in_flight -= 1;
        self.tasks.of(task).into_iter().for_each(|accounting| accounting.in_flight -= 1);
        self.end(Some(task), dropped);
    }

    /// Accounts for an unroll of this task as dropped for this reason, or without a reason as trained on.
    pub(crate) fn end(&mut self, task: Option<u32>, dropped: Option<Reason>) {
        let accounting = task.and_then(|task| self.tasks.of(task));
        match dropped {
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

    /// The accounting if unrolls of the tasks `waiting` wait for the trainer.
    pub(crate) fn accounting(&self, waiting: impl Iterator<Item = u32>) -> AccountingByTask {
        let (mut all, mut tasks) = (self.sums, self.tasks.clone());
        for task in waiting {
            all.in_flight += 1;
            tasks.of(task).into_iter().for_each(|accounting| accounting.in_flight += 1);
        }
        AccountingByTask { all, tasks: tasks.by_name() }
    }
}
