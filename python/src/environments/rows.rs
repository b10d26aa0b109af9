//! What a step gives besides observations.

use std::collections::BTreeMap;

use comic_tasks::{Achievement, Episode, Outcome, Simulated, Step};
use numpy::{IntoPyArray as _, PyArrayMethods as _};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Of one environment.
pub(super) struct Row {
    /// `None` after a reset.
    step: Option<Step>,
    /// The episode of the step.
    episode: Episode,
    /// The episode that began in the same step.
    begun: Option<Episode>,
    /// At the episode's end.
    achievement: Option<Achievement>,
}

impl Row {
    pub(super) fn of_reset(environment: &dyn Simulated) -> Self {
        Self { step: None, episode: environment.episode(), begun: None, achievement: None }
    }

    pub(super) fn of_step(step: Step, environment: &dyn Simulated) -> Self {
        let achievement = (step.outcome != Outcome::Running).then(|| environment.achievement());
        Self { step: Some(step), episode: environment.episode(), begun: None, achievement }
    }

    /// The same step, in which `environment` has also begun a new episode.
    pub(super) fn and_reset(self, environment: &dyn Simulated) -> Self {
        Self { begun: Some(environment.episode()), ..self }
    }
}

/// Of all environments, an array for each quantity.
#[derive(Default)]
pub(super) struct Rows {
    terms: usize,
    reward: Vec<f64>,
    reward_terms: Vec<f64>,
    terminated: Vec<bool>,
    truncated: Vec<bool>,
    diverged: Vec<bool>,
    head_height: Vec<f64>,
    /// Of the episode that is observed.
    clip: Vec<i64>,
    start: Vec<i64>,
    /// Of the step's episode.
    final_clip: Vec<i64>,
    final_start: Vec<i64>,
    success: Vec<bool>,
    /// NaN in the row of an episode that goes on.
    measures: BTreeMap<&'static str, Vec<f64>>,
}

impl Rows {
    pub(super) fn new(rows: &[Row], terms: usize) -> Self {
        let mut all = Self { terms, ..Self::default() };
        for (index, Row { step, episode, begun, achievement }) in rows.iter().enumerate() {
            let outcome = step.map_or(Outcome::Running, |step| step.outcome);
            all.reward.push(step.map_or(0.0, |step| step.reward()));
            let own = step.map(|step| step.reward_terms).unwrap_or_default();
            all.reward_terms.extend(&own[..terms.min(own.len())]);
            // A divergence ends the episode without a next observation, so its discount is 0 too.
            all.terminated.push(matches!(outcome, Outcome::Terminated | Outcome::Diverged));
            all.truncated.push(outcome == Outcome::Truncated);
            all.diverged.push(outcome == Outcome::Diverged);
            all.head_height.push(step.map_or(f64::NAN, |step| step.head_height));
            let observed = begun.as_ref().unwrap_or(episode);
            all.clip.push(observed.clip as i64);
            all.start.push(observed.start as i64);
            all.final_clip.push(episode.clip as i64);
            all.final_start.push(episode.start as i64);
            all.success.push(achievement.is_some_and(|achievement| achievement.success));
            for (name, value) in achievement.iter().flat_map(Achievement::measures) {
                all.measures.entry(name).or_insert_with(|| vec![f64::NAN; rows.len()])[index] = value;
            }
        }
        all
    }

    pub(super) fn into_dict(self, python: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
        let answer = PyDict::new(python);
        let shape = [self.reward.len(), self.terms];
        answer.set_item("reward", self.reward.into_pyarray(python))?;
        answer.set_item("reward_terms", self.reward_terms.into_pyarray(python).reshape(shape)?)?;
        answer.set_item("terminated", self.terminated.into_pyarray(python))?;
        answer.set_item("truncated", self.truncated.into_pyarray(python))?;
        answer.set_item("diverged", self.diverged.into_pyarray(python))?;
        answer.set_item("head_height", self.head_height.into_pyarray(python))?;
        answer.set_item("clip", self.clip.into_pyarray(python))?;
        answer.set_item("start", self.start.into_pyarray(python))?;
        answer.set_item("final_clip", self.final_clip.into_pyarray(python))?;
        answer.set_item("final_start", self.final_start.into_pyarray(python))?;
        answer.set_item("success", self.success.into_pyarray(python))?;
        let measures = PyDict::new(python);
        for (name, values) in self.measures {
            measures.set_item(name, values.into_pyarray(python))?;
        }
        answer.set_item("measures", measures)?;
        Ok(answer)
    }
}
