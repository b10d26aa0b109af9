//! The sums: what became of all unrolls, and of those of each task.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

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

/// Sums over the unrolls that are known to be of one task: `produced = trained + dropped + in flight`.
///
/// What nobody can tell the task of is in [`Accounting`] alone (numbers that were lost, invalid messages, and what another life of
/// the learner had asked for), so the tasks together come to no more than those.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskAccounting {
    /// Unrolls that were decided about.
    pub produced: u64,
    /// Unrolls trained on.
    pub trained: u64,
    /// Unrolls that never will be, by reason.
    pub dropped: Dropped,
    /// Unrolls in a batch that is open, full, or being trained on.
    pub in_flight: u64,
}

impl TaskAccounting {
    /// Whether `produced = trained + dropped + in flight`.
    pub fn balance(&self) -> bool {
        self.dropped.add_to([self.trained, self.in_flight]) == Some(self.produced)
    }
}

/// Everybody's accounting, and each task's, at one moment.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct AccountingByTask {
    /// Of all tasks, and of what is nobody's.
    pub all: Accounting,
    /// By the task's name.
    pub tasks: BTreeMap<String, TaskAccounting>,
}
