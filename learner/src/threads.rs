//! libtorch's threads beside other programs.

use std::os::unix::process::CommandExt as _;
use std::process::Command;

use comic_experiment::Experiment;

/// The variables by which libgomp is told how a thread waits for the others. It reads them when it is loaded.
const SPINS: &str = "GOMP_SPINCOUNT";
const POLICY: &str = "OMP_WAIT_POLICY";
/// How often a thread looks whether the others have finished before it sleeps. libgomp's default of 300,000 is milliseconds,
/// in which a neighbour of equal priority could have computed. docs/benchmarks.md has the figures.
const FEW_SPINS: &str = "30000";

/// Starts this program anew, as the same process, so that libtorch's threads soon sleep while they wait for each other. Does
/// nothing if the environment says how they wait, or if the program cannot be started again.
pub fn wait_passively() {
    if std::env::var_os(SPINS).is_some() || std::env::var_os(POLICY).is_some() {
        return;
    }
    let mut arguments = std::env::args_os();
    let Ok(program) = std::env::current_exe() else { return };
    let mut command = Command::new(program);
    if let Some(name) = arguments.next() {
        command.arg0(name);
    }
    let error = command.args(arguments).env(SPINS, FEW_SPINS).exec();
    tracing::warn!(%error, "libtorch's threads wait actively, because this program cannot be started anew");
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
