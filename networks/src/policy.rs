//! What every policy does, whichever algorithm trains it.

use std::fmt::Debug;

use comic_experiment::{Experiment, TaskSpec};
use tch::{Tensor, nn};

use crate::action::ActionDistribution;
use crate::error::Error;
use crate::gaussian::DiagonalGaussian;
use crate::lstm::RecurrentState;
use crate::normaliser::{NormalisedObservation, NormaliserStatistics};
use crate::routing::Routing;

/// The output of a policy for N rows.
#[derive(Debug)]
pub struct Acting {
    /// z_t = μ_θ + σ_θ·noise, `[N, Z]`; `[N, 0]` if the policy has no latent.
    pub latent: Tensor,
    /// π(a_t | s_t, z_t), over N rows.
    pub action: ActionDistribution,
    /// q(z_t | x_t, s_t, z_{t−1}), over `[N, Z]`; `None` if the policy has no latent.
    pub latent_posterior: Option<DiagonalGaussian>,
    /// p(z_t | s_t), over `[N, Z]`; `None` if the policy does not learn a prior of the state.
    pub latent_prior: Option<DiagonalGaussian>,
    /// The recurrent state after the last row of each unroll, `[B, S]`.
    pub state: Tensor,
}

/// A policy: what acting needs, and what the learner publishes.
pub trait Policy: Debug + Send {
    /// Normalises observations: proprioception `[.., P]`, task observation `[.., X]`, image `[.., I]` uint8. The
    /// leading dimensions are `[B]` or `[B, T]`; `routing` has the tasks of the B unrolls. Image features join the task
    /// observation.
    fn normalise(
        &self,
        proprioception: &Tensor,
        task: &Tensor,
        image: Option<&Tensor>,
        routing: &Routing,
    ) -> NormalisedObservation;

    /// Runs the policy on normalised observations, to act or to learn. `previous_latent` is the sampled z_{t−1}, `[..,
    /// Z]` (zeros at the start of an episode). `latent_noise` is the standard-normal noise of z_t, `[.., Z]`. All
    /// leading dimensions are equal: `[B, T]`, which are B·T rows, to learn; `[B]`, one step of B environments, to act.
    fn act(
        &self,
        observation: &NormalisedObservation,
        previous_latent: &Tensor,
        latent_noise: &Tensor,
        recurrent: RecurrentState<'_>,
    ) -> Acting;

    /// Sets the statistics of the normaliser. They are published with the parameters, and are not trained.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::Number`] if the statistics do not fit the task; then nothing changes.
    fn set_normaliser(&self, statistics: &NormaliserStatistics) -> Result<(), Error>;
}

/// What an algorithm has of its own in this crate.
pub(crate) trait Builder {
    /// The policy of an experiment with this algorithm, whose parameters are created in `store`. `pose` is the initial mean of
    /// the action, A entries in [−1, 1], if the policy has a low level of its own.
    ///
    /// # Errors
    /// [`Error::Length`] if `pose` is not an action of this task.
    fn policy(
        &self,
        store: &nn::Path,
        spec: &TaskSpec,
        experiment: &Experiment,
        pose: &[f32],
    ) -> Result<Box<dyn Policy>, Error>;

    /// How many weights such a policy has, without building it.
    fn weights(&self, spec: &TaskSpec, experiment: &Experiment) -> Weights;
}

/// Entries of the matrices of a policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Weights {
    /// Of a low level of its own.
    pub(crate) low_level: u64,
    /// Of a prior of the state that is learned with it.
    pub(crate) prior: u64,
    /// Of everything else.
    pub(crate) rest: u64,
}
