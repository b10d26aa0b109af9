//! Gradient steps that were skipped, since a loss or gradient was not finite, and what they lead to.

use anyhow::{Result, bail};
use serde_json::{Map, Value, json};

use crate::algorithm::Algorithm as _;
use crate::algorithm::losses::LossValues;
use crate::log_limiter::LogLimiter;
use crate::train::trainer::Trainer;

/// Counts skipped steps. Too many in a row lead back to the last good state; as many again, before as many were taken,
/// are the end: what goes wrong then goes wrong there too.
#[derive(Debug)]
pub(crate) struct SkippedSteps {
    /// How many in a row are too many.
    limit: u64,
    in_row: u64,
    /// Steps taken since the last return, until there are enough of them.
    since_return: Option<u64>,
    log_limiter: LogLimiter<()>,
}

/// What a learner does next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Recovery {
    Continue,
    Restore,
    GiveUp,
}

impl SkippedSteps {
    pub(crate) fn new(limit: u64) -> Self {
        Self { limit, in_row: 0, since_return: None, log_limiter: LogLimiter::default() }
    }

    /// Counts `steps`, of which so many were skipped, and so many after the last one that was taken.
    fn count(&mut self, steps: u64, skipped: u64, skipped_last: u64) -> Recovery {
        let taken = steps.saturating_sub(skipped);
        self.in_row = if taken == 0 { self.in_row + skipped } else { skipped_last };
        self.since_return = self.since_return.map(|since| since + taken).filter(|since| *since < self.limit);
        if self.in_row < self.limit {
            return Recovery::Continue;
        }
        self.in_row = 0;
        if self.since_return.replace(0).is_none() { Recovery::Restore } else { Recovery::GiveUp }
    }
}

impl Trainer {
    /// Whether the parameters are worth acting with and turning back to: every one is a number, and the last gradient
    /// step was taken. Parameters that are numbers, but too large to compute with, show themselves by the latter.
    pub(crate) fn is_sound(&self) -> bool {
        self.skipped_steps.in_row == 0 && self.learner.is_finite()
    }

    /// Keeps the newest losses for the metrics, and sees to the steps that were skipped. Says whether they led back to the
    /// last good state, which actors have to hear of.
    ///
    /// # Errors
    /// When the way back was taken already and led nowhere.
    pub(crate) fn report(&mut self, losses: &LossValues) -> Result<bool> {
        let LossValues { steps, skipped, skipped_last, .. } = *losses;
        let update = self.progress.updates;
        self.count_skipped(skipped);
        if skipped > 0 && self.skipped_steps.log_limiter.due(()).is_some() {
            tracing::warn!(update, skipped, of = steps, "gradient steps skipped: a loss or gradient is not finite");
        }
        let way = self.skipped_steps.count(steps, skipped, skipped_last);
        match way {
            Recovery::Continue => {}
            Recovery::Restore => self.restore_last_good()?,
            Recovery::GiveUp => bail!(
                "update {update}: losses and gradients are not finite, and were not after a return to the last good state \
                 either; the checkpoints are from before. The usual remedies are a lower optimiser.learning_rate or \
                 vmpo.epsilon_mean, and an optimiser.max_gradient_norm; else look at what the actors send"
            ),
        }
        if losses.is_finite() {
            self.losses = self.shown(losses);
        }
        Ok(way == Recovery::Restore)
    }

    pub(crate) fn count_skipped(&mut self, skipped: u64) {
        self.metrics.count_skipped(skipped);
        self.shared.telemetry.updates_skipped.inc_by(skipped);
    }

    /// Goes on with the parameters, moments and statistics of the last good state; what counts goes on counting. Unrolls of the versions before are superseded: whatever made them is what went wrong.
    fn restore_last_good(&mut self) -> Result<()> {
        self.restore_learner(&self.good.clone())?;
        self.shared.telemetry.restores.inc();
        self.oldest = self.progress.version + 1;
        tracing::warn!(
            update = self.progress.updates,
            "too many gradient steps in a row were skipped: went back to the last good state"
        );
        Ok(())
    }

    fn shown(&self, losses: &LossValues) -> Map<String, Value> {
        let mut shown: Map<_, _> =
            losses.entries().iter().map(|(name, value)| ((*name).to_string(), json!(value))).collect();
        if self.spec.tasks.len() > 1 && losses.temperatures.len() == self.spec.tasks.len() {
            let names = self.spec.tasks.iter().map(|task| task.name.clone());
            let temperatures: Map<_, _> = names.zip(losses.temperatures.iter().map(|eta| json!(eta))).collect();
            shown.insert("temperatures".to_string(), Value::Object(temperatures));
        }
        shown
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn so_many_skipped_in_a_row_lead_back_and_as_many_again_to_the_end() {
        let mut skipped_steps = SkippedSteps::new(4);
        assert_eq!(skipped_steps.count(3, 3, 3), Recovery::Continue);
        assert_eq!(skipped_steps.count(1, 1, 1), Recovery::Restore);
        assert_eq!(skipped_steps.count(3, 3, 3), Recovery::Continue);
        assert_eq!(skipped_steps.count(3, 3, 3), Recovery::GiveUp);
    }

    #[test]
    fn a_step_that_is_taken_ends_the_row_and_what_follows_begins_another() {
        let mut skipped_steps = SkippedSteps::new(4);
        for _ in 0..9 {
            assert_eq!(skipped_steps.count(5, 4, 2), Recovery::Continue);
        }
        assert_eq!(skipped_steps.count(2, 2, 2), Recovery::Restore);
    }

    #[test]
    fn a_return_is_forgotten_when_as_many_steps_were_taken_since() {
        for (taken, way) in [(3, Recovery::GiveUp), (4, Recovery::Restore)] {
            let mut skipped_steps = SkippedSteps::new(4);
            assert_eq!(skipped_steps.count(4, 4, 4), Recovery::Restore);
            assert_eq!(skipped_steps.count(taken, 0, 0), Recovery::Continue);
            assert_eq!(skipped_steps.count(4, 4, 4), way, "{taken}");
        }
    }
}
