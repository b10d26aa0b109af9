//! How much of the experiment's budget is used.

use std::time::Instant;

use comic_experiment::Budget;

use crate::checkpoint::progress::Progress;

/// The budget, and the clock that its minutes are counted by.
#[derive(Debug)]
pub(super) struct BudgetClock {
    limits: Budget,
    /// Seconds that earlier epochs of the learner counted.
    before: f64,
    /// The first batch of this epoch.
    started: Option<Instant>,
}

impl BudgetClock {
    /// A clock that continues after `before` seconds, and does not run yet.
    pub(super) fn new(limits: Budget, before: f64) -> Self {
        Self { limits, before, started: None }
    }

    /// Starts the clock, unless it runs already.
    pub(super) fn start(&mut self) {
        self.started.get_or_insert_with(Instant::now);
    }

    /// Wall-clock seconds, those of earlier epochs included.
    pub(super) fn seconds(&self) -> f64 {
        self.before + self.started.map_or(0.0, |started| started.elapsed().as_secs_f64())
    }

    /// The fraction of the budget that is used, by the limit that is nearest; at least 1 when the budget is used up.
    pub(super) fn used(&self, progress: &Progress) -> f64 {
        [
            (self.seconds() / 60.0, self.limits.minutes),
            (progress.environment_steps as f64, self.limits.environment_steps as f64),
            (progress.updates as f64, self.limits.updates as f64),
        ]
        .into_iter()
        .filter(|(_, limit)| *limit > 0.0)
        .map(|(used, limit)| used / limit)
        .fold(0.0, f64::max)
    }
}
