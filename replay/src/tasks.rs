//! The same accounting for each task of joint training.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::ledger::{Accounting, Dropped};

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

/// The tasks of a run with their accounting, in the order of the indices in the unrolls' headers.
#[derive(Clone, Debug, Default)]
pub(crate) struct Tasks {
    tasks: Vec<(String, TaskAccounting)>,
}

impl Tasks {
    /// These tasks. Each takes its accounting out of `known`, or begins a new one.
    pub(crate) fn new(tasks: impl IntoIterator<Item = String>, known: &mut BTreeMap<String, TaskAccounting>) -> Self {
        let with_accounting = |name: String| {
            let accounting = known.remove(&name).unwrap_or_default();
            (name, accounting)
        };
        Self { tasks: tasks.into_iter().map(with_accounting).collect() }
    }

    /// The accounting of the task with this index.
    pub(crate) fn of(&mut self, task: u32) -> Option<&mut TaskAccounting> {
        self.tasks.get_mut(task as usize).map(|(_, accounting)| accounting)
    }

    /// Every task's accounting by its name.
    pub(crate) fn by_name(self) -> BTreeMap<String, TaskAccounting> {
        self.tasks.into_iter().collect()
    }
}
