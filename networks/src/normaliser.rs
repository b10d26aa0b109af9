//! Normalises observations to mean 0 and standard deviation 1 with fixed statistics.

use comic_experiment::TaskSpec;
use tch::{Tensor, nn};

use crate::error::Error;
use crate::routing::Routing;

/// Normalised observations are clamped to ± this number of standard deviations (D).
pub const NORMALISED_LIMIT: f64 = 10.0;
/// Least standard deviation, in the unit of the observation (D). Without it an observation that was constant during the
/// measurement would become huge when it changes.
pub const NORMALISER_MIN_STD: f32 = 1e-2;

/// Mean and standard deviation of every observation entry, measured on the first environment steps.
#[derive(Clone, Debug, PartialEq)]
pub struct NormaliserStatistics {
    /// Mean of proprioception, P entries.
    pub proprioception_mean: Vec<f32>,
    /// Standard deviation of proprioception, P entries.
    pub proprioception_std: Vec<f32>,
    /// Mean of the task observation, X entries for each task.
    pub task_mean: Vec<f32>,
    /// Standard deviation of the task observation, X entries for each task.
    pub task_std: Vec<f32>,
}

/// Observations that a policy has normalised, with their routing. A [`Value`](crate::Value) reads only this type, so
/// policy and value always use the same scale and the same task.
#[derive(Debug)]
pub struct NormalisedObservation {
    pub(crate) proprioception: Tensor,
    pub(crate) task: Tensor,
    pub(crate) routing: Routing,
}

impl NormalisedObservation {
    /// The task observation, with the features of the image at its end, `[.., X+F]`.
    pub fn task(&self) -> &Tensor {
        &self.task
    }

    /// The first `steps` of observations `[B, T, ·]`: views `[B, steps, ·]`, no copy.
    pub fn first_steps(&self, steps: i64) -> Self {
        Self {
            proprioception: self.proprioception.narrow(1, 0, steps),
            task: self.task.narrow(1, 0, steps),
            routing: self.routing.shallow_clone(),
        }
    }

    /// Observations `[B, T, ·]`; those of one step, `[B, ·]`, become `[B, 1, ·]`.
    pub(crate) fn with_steps(&self) -> Self {
        let stepped = |tensor: &Tensor| if tensor.dim() == 2 { tensor.unsqueeze(1) } else { tensor.shallow_clone() };
        Self {
            proprioception: stepped(&self.proprioception),
            task: stepped(&self.task),
            routing: self.routing.shallow_clone(),
        }
    }
}

/// The statistics as parameters that are published but not trained. Until they are set, normalisation is the identity.
#[derive(Debug)]
pub(crate) struct Normaliser {
    /// False if the experiment uses raw observations; then observations are not changed.
    active: bool,
    proprioception_mean: Tensor,
    proprioception_std: Tensor,
    /// `[tasks, X]`.
    task_mean: Tensor,
    /// `[tasks, X]`.
    task_std: Tensor,
}

impl Normaliser {
    pub(crate) fn new(path: &nn::Path, spec: &TaskSpec, active: bool) -> Self {
        let proprioception = [spec.proprioception as i64];
        let task = [spec.tasks.len() as i64, spec.task as i64];
        Self {
            active,
            proprioception_mean: path.zeros_no_train("proprioception_mean", &proprioception),
            proprioception_std: path.ones_no_train("proprioception_std", &proprioception),
            task_mean: path.zeros_no_train("task_mean", &task),
            task_std: path.ones_no_train("task_std", &task),
        }
    }

    pub(crate) fn forward(&self, proprioception: &Tensor, task: &Tensor, routing: &Routing) -> NormalisedObservation {
        let kept = routing.shallow_clone();
        if !self.active {
            return NormalisedObservation {
                proprioception: proprioception.shallow_clone(),
                task: task.shallow_clone(),
                routing: kept,
            };
        }
        // Each unroll uses the statistics of its task in every step.
        let of_task = |statistics: &Tensor| match routing.tasks() {
            None => statistics.select(0, 0),
            Some(tasks) if task.dim() > 2 => statistics.index_select(0, tasks).unsqueeze(1),
            Some(tasks) => statistics.index_select(0, tasks),
        };
        NormalisedObservation {
            proprioception: normalise(proprioception, &self.proprioception_mean, &self.proprioception_std),
            task: normalise(task, &of_task(&self.task_mean), &of_task(&self.task_std)),
            routing: kept,
        }
    }

    pub(crate) fn set(&self, statistics: &NormaliserStatistics) -> Result<(), Error> {
        let NormaliserStatistics { proprioception_mean, proprioception_std, task_mean, task_std } = statistics;
        let entries = [
            ("normaliser.proprioception_mean", proprioception_mean, &self.proprioception_mean, false),
            ("normaliser.proprioception_std", proprioception_std, &self.proprioception_std, true),
            ("normaliser.task_mean", task_mean, &self.task_mean, false),
            ("normaliser.task_std", task_std, &self.task_std, true),
        ];
        for (name, values, buffer, is_std) in &entries {
            let expected = buffer.numel();
            if values.len() != expected {
                return Err(Error::Length { name, expected, found: values.len() });
            }
            if !values.iter().all(|value| value.is_finite() && (!is_std || *value >= 0.0)) {
                return Err(Error::Number {
                    name: (*name).into(),
                    what: "a number that is not a valid mean or standard deviation",
                });
            }
        }
        for (_, values, buffer, is_std) in entries {
            let mut values = Tensor::from_slice(values);
            if is_std {
                values = values.clamp_min(f64::from(NORMALISER_MIN_STD));
            }
            tch::no_grad(|| buffer.shallow_clone().f_copy_(&values.view_as(buffer))).map(drop)?;
        }
        Ok(())
    }
}

pub(crate) fn normalise(observation: &Tensor, mean: &Tensor, std: &Tensor) -> Tensor {
    (observation - mean).divide_(std).clamp_(-NORMALISED_LIMIT, NORMALISED_LIMIT)
}
