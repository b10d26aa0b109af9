//! Gradient steps that were skipped, because a loss or a gradient was not finite, and how training recovers.

use crate::algorithm::loss_report::LossValues;
use crate::log_limiter::LogLimiter;

/// What an operator is told when training gives up. `usual` are the algorithm's usual remedies.
pub(super) fn remedies(usual: &str) -> String {
    format!(
        "losses and gradients are not finite, and were not after a return to the last good state either; the checkpoints are \
        from before. The usual remedies are {usual}; else look at what the actors send"
    )
}

/// Counts skipped steps. Too many in a row restore the last good state. As many again, before as many steps were taken,
/// end training: the same failure would come back.
#[derive(Debug)]
pub(super) struct SkippedSteps {
    /// How many in a row are too many.
    limit: u64,
    in_row: u64,
    /// Steps taken since the last good state was restored, until there are enough of them.
    since_restore: Option<u64>,
    log_limiter: LogLimiter<()>,
}

/// What the trainer does next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Recovery {
    Continue,
    Restore,
    GiveUp,
}

impl SkippedSteps {
    pub(super) fn new(limit: u64) -> Self {
        Self { limit, in_row: 0, since_restore: None, log_limiter: LogLimiter::default() }
    }

    /// Whether the last gradient step was skipped. The parameters may then be finite, but too large to compute with.
    pub(super) fn last_was_skipped(&self) -> bool {
        self.in_row > 0
    }

    /// Counts the steps of an update, and logs skipped ones.
    pub(super) fn count(&mut self, losses: &LossValues, update: u64) -> Recovery {
        let LossValues { steps, skipped, skipped_last, .. } = *losses;
        if skipped > 0 && self.log_limiter.due(()).is_some() {
            tracing::warn!(update, skipped, of = steps, "gradient steps skipped: a loss or gradient is not finite");
        }
        self.count_steps(steps, skipped, skipped_last)
    }

    /// Counts `steps`, of which `skipped` were skipped, and `skipped_last` after the last one that was taken.
    fn count_steps(&mut self, steps: u64, skipped: u64, skipped_last: u64) -> Recovery {
        let taken = steps.saturating_sub(skipped);
        self.in_row = if taken == 0 { self.in_row + skipped } else { skipped_last };
        self.since_restore = self.since_restore.map(|since| since + taken).filter(|since| *since < self.limit);
        if self.in_row < self.limit {
            return Recovery::Continue;
        }
        self.in_row = 0;
        if self.since_restore.replace(0).is_none() { Recovery::Restore } else { Recovery::GiveUp }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_many_skipped_in_a_row_restore_the_last_good_state_and_as_many_again_give_up() {
        let mut skipped_steps = SkippedSteps::new(4);
        assert_eq!(skipped_steps.count_steps(3, 3, 3), Recovery::Continue);
        assert_eq!(skipped_steps.count_steps(1, 1, 1), Recovery::Restore);
        assert_eq!(skipped_steps.count_steps(3, 3, 3), Recovery::Continue);
        assert_eq!(skipped_steps.count_steps(3, 3, 3), Recovery::GiveUp);
    }

    #[test]
    fn a_step_that_is_taken_ends_the_row() {
        let mut skipped_steps = SkippedSteps::new(4);
        for _ in 0..9 {
            assert_eq!(skipped_steps.count_steps(5, 4, 2), Recovery::Continue);
        }
        assert_eq!(skipped_steps.count_steps(2, 2, 2), Recovery::Restore);
    }

    #[test]
    fn after_enough_taken_steps_the_last_good_state_is_restored_again() {
        for (taken, recovery) in [(3, Recovery::GiveUp), (4, Recovery::Restore)] {
            let mut skipped_steps = SkippedSteps::new(4);
            assert_eq!(skipped_steps.count_steps(4, 4, 4), Recovery::Restore);
            assert_eq!(skipped_steps.count_steps(taken, 0, 0), Recovery::Continue);
            assert_eq!(skipped_steps.count_steps(4, 4, 4), recovery, "{taken}");
        }
    }
}
