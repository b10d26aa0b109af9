//! The accounting of each task.

use std::collections::BTreeMap;

use crate::accounting::TaskAccounting;

/// The tasks of a run with their accounting, in the order of the task indices in the headers of unrolls.
#[derive(Clone, Debug, Default)]
pub(crate) struct Tasks {
    tasks: Vec<(String, TaskAccounting)>,
}

impl Tasks {
    /// These tasks. Each one continues its accounting in `known`, which is removed there, or begins a new one.
    pub(crate) fn new(tasks: impl IntoIterator<Item = String>, known: &mut BTreeMap<String, TaskAccounting>) -> Self {
        let with_accounting = |name: String| {
            let accounting = known.remove(&name).unwrap_or_default();
            (name, accounting)
        };
        Self { tasks: tasks.into_iter().map(with_accounting).collect() }
    }

    /// The accounting of the task with this index; `None` for an unknown index.
    pub(crate) fn of(&mut self, task: u32) -> Option<&mut TaskAccounting> {
        self.tasks.get_mut(task as usize).map(|(_, accounting)| accounting)
    }

    /// The accounting of each task, by its name.
    pub(crate) fn by_name(self) -> BTreeMap<String, TaskAccounting> {
        self.tasks.into_iter().collect()
    }
}
