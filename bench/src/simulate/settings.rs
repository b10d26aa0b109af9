//! What is simulated.

use anyhow::{Result, ensure};
use serde::Serialize;

/// Most environments of a simulation, so that it fits into memory.
const MOST_ENVIRONMENTS: usize = 10_000_000;
/// Bits of a gigabit, in bytes.
const GIGABIT: f64 = 1e9 / 8.0;

/// One point of a sweep.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Settings {
    pub(super) actors: usize,
    pub(super) threads: usize,
    pub(super) environments: usize,
    pub(super) learners: usize,
    pub(super) link_gbps: f64,
    pub(super) shared_link: bool,
    pub(super) step_us: f64,
    pub(super) length: usize,
    pub(super) batch: usize,
    pub(super) ahead: usize,
    pub(super) update_ms: f64,
    pub(super) target_period: u64,
    pub(super) max_staleness: u64,
    pub(super) unroll_bytes: f64,
    pub(super) parameter_bytes: f64,
    pub(super) gradient_bytes: f64,
    pub(super) all_reduce_gbps: f64,
    pub(super) exchange_ms: f64,
    pub(super) asset_bytes: f64,
    pub(super) start_s: f64,
    pub(super) spread: f64,
    pub(super) any_version: bool,
    pub(super) seconds: f64,
    pub(super) versions: u64,
    pub(super) give_up_s: f64,
    pub(super) seed: u64,
}

impl Settings {
    /// Refuses what cannot be simulated.
    ///
    /// # Errors
    /// Names the options.
    pub(super) fn check(&self) -> Result<()> {
        let Self { actors, threads, environments, learners, batch, .. } = *self;
        let all = actors.checked_mul(threads).and_then(|workers| workers.checked_mul(environments));
        ensure!(
            all.is_some_and(|all| all <= MOST_ENVIRONMENTS),
            "--actors {actors} --threads {threads} --environments {environments}: at most {MOST_ENVIRONMENTS} environments"
        );
        ensure!(actors >= learners, "--learners {learners}: more than --actors {actors}");
        ensure!(batch % learners == 0, "--batch {batch}: not a multiple of --learners {learners}");
        Ok(())
    }

    /// Threads of all actors.
    pub(super) fn workers(&self) -> usize {
        self.actors * self.threads
    }

    /// Seconds in which a worker makes an unroll of each of its environments.
    pub(super) fn round(&self) -> f64 {
        (self.environments * self.length) as f64 * self.step_us / 1e6
    }

    /// Seconds of an update without its exchanges. A learner has its part of the batch, and its time is in proportion.
    pub(super) fn compute(&self) -> f64 {
        self.update_ms / 1e3 / self.learners as f64
    }

    /// Seconds of an update in which the learners exchange what they need of each other: a fixed part, and gradients that go
    /// around a ring. The ring has the link to itself; the backend may be slower than the link.
    pub(super) fn exchanges(&self) -> f64 {
        if self.learners == 1 {
            return 0.0;
        }
        let learners = self.learners as f64;
        let bytes_per_second = self.link_gbps.min(self.all_reduce_gbps) * GIGABIT;
        self.exchange_ms / 1e3 + 2.0 * (learners - 1.0) / learners * self.gradient_bytes / bytes_per_second
    }

    /// Bytes a second of a learner's link, in each direction.
    pub(super) fn bytes_per_second(&self) -> f64 {
        self.link_gbps * GIGABIT
    }

    /// As `Experiment::max_versions_late`.
    pub(super) fn max_versions_late(&self) -> u64 {
        self.max_staleness.div_ceil(self.target_period)
    }

    /// Environment steps a second that the actors can make if they never wait.
    pub(super) fn actor_bound(&self) -> f64 {
        self.workers() as f64 * 1e6 / self.step_us
    }

    /// Environment steps a second that the learners can learn from if they never wait.
    pub(super) fn learner_bound(&self) -> f64 {
        (self.batch * self.length) as f64 / (self.compute() + self.exchanges())
    }

    /// Environment steps a second whose unrolls the links can carry.
    pub(super) fn link_bound(&self) -> f64 {
        self.learners as f64 * self.bytes_per_second() / self.unroll_bytes * self.length as f64
    }
}
