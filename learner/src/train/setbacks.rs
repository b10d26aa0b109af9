//! Gradient steps that were skipped, since a loss or gradient was not finite, and what they lead to.

use anyhow::{Result, bail};
use serde_json::{Map, Value, json};

use crate::complaints::Complaints;
use crate::train::trainer::Trainer;
use crate::vmpo;

/// Counts skipped steps. Too many in a row lead back to the last good state; as many again, before as many were taken,
/// are the end: what goes wrong then goes wrong there too.
#[derive(Debug)]
pub(crate) struct Setbacks {
    /// How many in a row are too many.
    limit: u64,
    in_row: u64,
    /// Steps taken since the last return, until there are enough of them.
    since_return: Option<u64>,
    complaints: Complaints<()>,
}

/// What a learner does next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    On,
    Back,
    Nowhere,
}

impl Setbacks {
    pub(crate) fn new(limit: u64) -> Self {
        Self { limit, in_row: 0, since_return: None, complaints: Complaints::default() }
    }

    /// Counts `steps`, of which so many were skipped, and so many after the last one that was taken.
    fn count(&mut self, steps: u64, skipped: u64, skipped_last: u64) -> Way {
        let taken = steps.saturating_sub(skipped);
        self.in_row = if taken == 0 { self.in_row + skipped } else { skipped_last };
        self.since_return = self.since_return.map(|since| since + taken).filter(|since| *since < self.limit);
        if self.in_row < self.limit {
            return Way::On;
        }
        self.in_row = 0;
        if self.since_return.replace(0).is_none() { Way::Back } else { Way::Nowhere }
    }
}

impl Trainer {
    /// Whether the parameters are worth acting with and turning back to: every one is a number, and the last gradient
    /// step was taken. Parameters that are numbers, but too large to compute with, show themselves by the latter.
    pub(crate) fn is_sound(&self) -> bool {
        self.setbacks.in_row == 0 && self.learner.is_finite()
    }

    /// Keeps the newest losses for the metrics, and sees to the steps that were skipped. Says whether they led back to the
    /// last good state, which actors have to hear of.
    ///
    /// # Errors
    /// When the way back was taken already and led nowhere.
    pub(crate) fn report(&mut self, losses: &vmpo::Metrics) -> Result<bool> {
        let vmpo::Metrics { steps, skipped, skipped_last, .. } = *losses;
        let update = self.progress.updates;
        self.count_skipped(skipped);
        if skipped > 0 && self.setbacks.complaints.due(()).is_some() {
            tracing::warn!(update, skipped, of = steps, "gradient steps skipped: a loss or gradient is not finite");
        }
        let way = self.setbacks.count(steps, skipped, skipped_last);
        match way {
            Way::On => {}
            Way::Back => self.turn_back()?,
            Way::Nowhere => bail!(
                "update {update}: losses and gradients are not finite, and were not after a return to the last good state \
                 either; the checkpoints are from before. The usual remedies are a lower optimiser.learning_rate or \
                 vmpo.epsilon_mean, and an optimiser.max_gradient_norm; else look at what the actors send"
            ),
        }
        if losses.is_finite() {
            self.losses = self.shown(losses);
        }
        Ok(way == Way::Back)
    }

    pub(crate) fn count_skipped(&mut self, skipped: u64) {
        self.metrics.count_skipped(skipped);
        self.shared.telemetry.updates_skipped.inc_by(skipped);
    }

    /// Goes on with the parameters, moments and statistics of the last good state; what counts goes on counting. Unrolls of the versions before are superseded: whatever made them is what went wrong.
    fn turn_back(&mut self) -> Result<()> {
        self.restore_learner(&self.good.clone())?;
        self.shared.telemetry.restores.inc();
        self.oldest = self.progress.version + 1;
        tracing::warn!(
            update = self.progress.updates,
            "too many gradient steps in a row were skipped: went back to the last good state"
        );
        Ok(())
    }

    fn shown(&self, losses: &vmpo::Metrics) -> Map<String, Value> {
        let mut shown: Map<_, _> =
            losses.entries().into_iter().map(|(name, value)| (name.to_string(), json!(value))).collect();
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
        let mut setbacks = Setbacks::new(4);
        assert_eq!(setbacks.count(3, 3, 3), Way::On);
        assert_eq!(setbacks.count(1, 1, 1), Way::Back);
        assert_eq!(setbacks.count(3, 3, 3), Way::On);
        assert_eq!(setbacks.count(3, 3, 3), Way::Nowhere);
    }

    #[test]
    fn a_step_that_is_taken_ends_the_row_and_what_follows_begins_another() {
        let mut setbacks = Setbacks::new(4);
        for _ in 0..9 {
            assert_eq!(setbacks.count(5, 4, 2), Way::On);
        }
        assert_eq!(setbacks.count(2, 2, 2), Way::Back);
    }

    #[test]
    fn a_return_is_forgotten_when_as_many_steps_were_taken_since() {
        for (taken, way) in [(3, Way::Nowhere), (4, Way::Back)] {
            let mut setbacks = Setbacks::new(4);
            assert_eq!(setbacks.count(4, 4, 4), Way::Back);
            assert_eq!(setbacks.count(taken, 0, 0), Way::On);
            assert_eq!(setbacks.count(4, 4, 4), way, "{taken}");
        }
    }
}
