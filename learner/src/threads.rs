//! libtorch's threads beside other programs, and its memory.

use std::os::unix::process::CommandExt as _;
use std::process::Command;

use comic_experiment::Experiment;

/// The variables by which libgomp is told how a thread waits for the others.
const SPINS: &str = "GOMP_SPINCOUNT";
const POLICY: &str = "OMP_WAIT_POLICY";

/// What the libraries of this program read when they are loaded, unless the user has set it. docs/benchmarks.md has the figures.
const ENVIRONMENT: [(&str, &str); 4] = [
    // How often a thread looks whether the others have finished before it sleeps. libgomp's default of 300,000 is milliseconds,
    // in which another program could have computed, for instance an actor.
    (SPINS, "3000"),
    // glibc gives tensors of megabytes back to the system when they are freed, and the system clears every page of the next
    // tensor: a tenth of an update. Let it keep them: tensors of up to 32 MiB, the most that every glibc takes, and 64 GiB in all.
    ("MALLOC_MMAP_THRESHOLD_", "33554432"),
    ("MALLOC_TRIM_THRESHOLD_", "68719476736"),
    // Only glibc's first arena keeps large blocks, and the trainer's thread would have another. Rust's own memory is mimalloc's.
    ("MALLOC_ARENA_MAX", "1"),
];

/// Starts this program anew, as the same process, so that libtorch's threads soon sleep while they wait for each other, and its
/// memory is kept for the next update. Does nothing if the environment says all of it, or if the program cannot be started again.
pub fn prepare_libraries() {
    let is_set = |name: &str| std::env::var_os(name).is_some();
    let missing: Vec<_> =
        ENVIRONMENT.into_iter().filter(|(name, _)| !is_set(name) && (*name != SPINS || !is_set(POLICY))).collect();
    if missing.is_empty() {
        return;
    }
    let mut arguments = std::env::args_os();
    let Ok(program) = std::env::current_exe() else { return };
    let mut command = Command::new(program);
    if let Some(name) = arguments.next() {
        command.arg0(name);
    }
    let error = command.args(arguments).envs(missing).exec();
    tracing::warn!(%error, "libtorch will be slower, because this program cannot be started anew");
}

/// As many threads as the experiment wants, and no more than the cores that this process may use, its cgroup's quota included:
/// threads that take turns on one core wait for each other at the end of every operation. In lockstep the number is not
/// changed, because results depend on it.
pub fn of(experiment: &Experiment) -> usize {
    let wanted = experiment.learner.threads;
    match std::thread::available_parallelism() {
        Ok(cores) if cores.get() < wanted => {
            tracing::warn!(cores, "learner.threads is {wanted}, and there are fewer cores");
            if experiment.unroll.lockstep { wanted } else { cores.get() }
        }
        _ => wanted,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_are_no_more_threads_than_cores_except_in_lockstep() {
        let cores = std::thread::available_parallelism().unwrap().get();
        let mut experiment = Experiment::default();
        for (lockstep, wanted, expected) in [(false, cores + 1, cores), (true, cores + 1, cores + 1), (false, 1, 1)] {
            (experiment.unroll.lockstep, experiment.learner.threads) = (lockstep, wanted);
            assert_eq!(of(&experiment), expected, "lockstep {lockstep}, {wanted} wanted");
        }
    }
}
