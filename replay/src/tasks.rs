//! The same accounting for each task of joint training.

use std::collections::BTreeMap;

use crate::accounting::TaskAccounting;

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
