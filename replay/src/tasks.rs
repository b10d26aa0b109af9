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

/// A task of the run, with clips of its own.
#[derive(Clone, Debug)]
struct Part {
    name: String,
    /// Their number. Clips are counted through all tasks.
    clips: usize,
    accounting: TaskAccounting,
}

/// The tasks of a run, in their order.
#[derive(Clone, Debug, Default)]
pub(crate) struct Tasks {
    parts: Vec<Part>,
}

impl Tasks {
    /// These tasks, with the accounting that are `known` of them, which are taken out.
    pub(crate) fn new(
        tasks: impl IntoIterator<Item = (String, usize)>,
        known: &mut BTreeMap<String, TaskAccounting>,
    ) -> Self {
        let part = |(name, clips)| Part { accounting: known.remove(&name).unwrap_or_default(), name, clips };
        Self { parts: tasks.into_iter().map(part).collect() }
    }

    /// The accounting of the task that has this clip.
    pub(crate) fn of(&mut self, clip: u32) -> Option<&mut TaskAccounting> {
        let mut clip = clip as usize;
        let found = self.parts.iter_mut().find(|part| match clip.checked_sub(part.clips) {
            Some(rest) => {
                clip = rest;
                false
            }
            None => true,
        });
        found.map(|part| &mut part.accounting)
    }

    /// Every task's accounting by its name.
    pub(crate) fn by_name(self) -> BTreeMap<String, TaskAccounting> {
        self.parts.into_iter().map(|part| (part.name, part.accounting)).collect()
    }
}
