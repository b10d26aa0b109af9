//! How much memory this process may use.

use sysinfo::{ProcessRefreshKind, ProcessesToUpdate, System};

/// Bytes that this process may use: the limit of its cgroup, or else the machine's memory. `None` where the system does not
/// say.
pub(crate) fn memory_limit() -> Option<u64> {
    let mut system = System::new().ok()?;
    system.refresh_memory();
    let own = sysinfo::get_current_pid().ok()?;
    system.refresh_processes_specifics(ProcessesToUpdate::Some(&[own]), false, ProcessRefreshKind::nothing());
    let cgroup = system.process(own).and_then(|process| process.cgroup_limits());
    let machine = system.total_memory();
    cgroup.map(|limits| limits.total_memory.min(machine)).or(Some(machine)).filter(|bytes| *bytes > 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_may_use_some_memory_and_not_all_addresses() {
        let limit = memory_limit().unwrap();
        assert!((1 << 28..1 << 50).contains(&limit), "{limit}");
    }
}
