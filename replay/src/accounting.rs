//! The sums over all unrolls, and over the unrolls of each task.

use std::collections::BTreeMap;
use std::ops::AddAssign;

use serde::{Deserialize, Serialize};

/// Sums over all unrolls that were produced for this run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Accounting {
    /// Unrolls that were produced, according to their sequence numbers.
    pub produced: u64,
    /// Unrolls trained on.
    pub trained: u64,
    /// Dropped unrolls by reason.
    pub dropped: Dropped,
    /// Unrolls in a batch that is open, full, or at the trainer.
    pub in_flight: u64,
    /// Messages that repeated an unroll of the accounting; not part of the sum.
    pub duplicates: u64,
    /// Messages that were refused because they belong to no account; not part of the sum.
    pub unattributed: u64,
}

impl Accounting {
    /// Whether `produced = trained + dropped + in flight`.
    pub fn balance(&self) -> bool {
        self.dropped.add_to([self.trained, self.in_flight]) == Some(self.produced)
    }
}

impl AddAssign for Accounting {
    fn add_assign(&mut self, other: Self) {
        let Self { produced, trained, dropped, in_flight, duplicates, unattributed } = other;
        add(&mut self.produced, produced);
        add(&mut self.trained, trained);
        self.dropped += dropped;
        add(&mut self.in_flight, in_flight);
        add(&mut self.duplicates, duplicates);
        add(&mut self.unattributed, unattributed);
    }
}

/// Adds numbers of another rank, which come over the network.
fn add(sum: &mut u64, other: u64) {
    *sum = sum.saturating_add(other);
}

/// Dropped unrolls by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dropped {
    /// The parameters were older than the experiment allows.
    pub stale: u64,
    /// The validation failed.
    pub invalid: u64,
    /// Made in another epoch, or in a phase that has ended.
    pub superseded: u64,
    /// Received by or sent to an earlier learner epoch that ended before it trained on them.
    pub lost_at_restart: u64,
}

impl AddAssign for Dropped {
    fn add_assign(&mut self, other: Self) {
        let Self { stale, invalid, superseded, lost_at_restart } = other;
        add(&mut self.stale, stale);
        add(&mut self.invalid, invalid);
        add(&mut self.superseded, superseded);
        add(&mut self.lost_at_restart, lost_at_restart);
    }
}

impl Dropped {
    /// The sum over all reasons.
    pub fn total(&self) -> u64 {
        self.stale + self.invalid + self.superseded + self.lost_at_restart
    }

    /// The sum of `others` and all reasons; `None` if a u64 overflows.
    pub(crate) fn add_to(&self, others: [u64; 2]) -> Option<u64> {
        let reasons = [self.stale, self.invalid, self.superseded, self.lost_at_restart];
        others.into_iter().chain(reasons).try_fold(0u64, u64::checked_add)
    }

    /// Adds unrolls with this reason.
    pub(crate) fn count(&mut self, reason: Reason, unrolls: u64) {
        *match reason {
            Reason::Stale => &mut self.stale,
            Reason::Invalid => &mut self.invalid,
            Reason::Superseded => &mut self.superseded,
            Reason::LostAtRestart => &mut self.lost_at_restart,
        } += unrolls;
    }
}

/// The reason why an unroll was dropped.
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

/// Sums over the unrolls of one task: `produced = trained + dropped + in flight`.
///
/// Unrolls without a known task are only in [`Accounting`]: lost numbers, invalid messages, and unrolls of another
/// learner epoch. So the sum over the tasks is at most the total.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskAccounting {
    /// Unrolls that were accepted or dropped.
    pub produced: u64,
    /// Unrolls trained on.
    pub trained: u64,
    /// Dropped unrolls by reason.
    pub dropped: Dropped,
    /// Unrolls in a batch that is open, full, or at the trainer.
    pub in_flight: u64,
}

impl AddAssign for TaskAccounting {
    fn add_assign(&mut self, other: Self) {
        let Self { produced, trained, dropped, in_flight } = other;
        add(&mut self.produced, produced);
        add(&mut self.trained, trained);
        self.dropped += dropped;
        add(&mut self.in_flight, in_flight);
    }
}

impl TaskAccounting {
    /// Whether `produced = trained + dropped + in flight`.
    pub fn balance(&self) -> bool {
        self.dropped.add_to([self.trained, self.in_flight]) == Some(self.produced)
    }
}

/// The total accounting and that of each task, at the same moment.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AccountingByTask {
    /// The total, with unrolls without a known task.
    pub all: Accounting,
    /// The accounting of each task, by its name.
    pub tasks: BTreeMap<String, TaskAccounting>,
}

impl AddAssign for AccountingByTask {
    fn add_assign(&mut self, other: Self) {
        self.all += other.all;
        for (task, accounting) in other.tasks {
            *self.tasks.entry(task).or_default() += accounting;
        }
    }
}
