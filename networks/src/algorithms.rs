//! The policy of whichever algorithm an experiment names.

use comic_experiment::{AlgorithmName, Experiment, TaskSpec, for_each_algorithm};
use tch::nn;

use crate::error::Error;
use crate::policy::{Builder, Policy, Weights};

macro_rules! builders {
    ($($(#[$description:meta])* $algorithm:ident, $module:ident;)*) => {
        fn builder(algorithm: AlgorithmName) -> &'static dyn Builder {
            match algorithm {
                $(AlgorithmName::$algorithm => &crate::$module::Builder,)*
            }
        }
    };
}

for_each_algorithm!(builders);

/// The policy of an experiment. Its parameters are created in `store`. `pose` is the initial mean of the action, A entries in
/// [−1, 1]; 0 is the middle of a joint's range. A policy without a low level of its own does not use it.
///
/// # Errors
/// [`Error::Length`] if `pose` is not an action of this task.
pub fn new_policy(
    store: &nn::Path,
    spec: &TaskSpec,
    experiment: &Experiment,
    pose: &[f32],
) -> Result<Box<dyn Policy>, Error> {
    builder(experiment.algorithm).policy(store, spec, experiment, pose)
}

/// How many weights [`new_policy`] would create.
pub(crate) fn weights(spec: &TaskSpec, experiment: &Experiment) -> Weights {
    builder(experiment.algorithm).weights(spec, experiment)
}
