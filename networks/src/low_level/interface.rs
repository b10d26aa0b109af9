//! The interface of all low levels.

use std::fmt::Debug;

use comic_experiment::Network;
use tch::Tensor;

use crate::action::ActionDistribution;
use crate::lstm::RecurrentState;

/// π(a_t | s_t, z_t, h_t), where h_t is the recurrent state, if any.
pub(crate) trait LowLevel: Debug + Send {
    /// The distribution of actions for N = B·T rows.
    fn act(&self, input: &Input<'_>) -> Output;
}

/// The input of a low level: N = B·T rows, unroll by unroll.
pub(crate) struct Input<'a> {
    /// z_t, `[N, Z]`; without a bottleneck the encoder's logits of the K weights, `[N, K]`.
    pub(crate) intent: &'a Tensor,
    /// s_t, `[N, P]`, normalised.
    pub(crate) proprioception: &'a Tensor,
    /// The recurrent state before the first row of each unroll.
    pub(crate) recurrent: RecurrentState<'a>,
}

/// The output of a low level.
pub(crate) struct Output {
    /// π(a_t | …), over N rows.
    pub(crate) action: ActionDistribution,
    /// The recurrent state after the last row of each unroll, `[B, S]`.
    pub(crate) state: Tensor,
}

/// Sizes and initial values of a low level.
pub(crate) struct Config<'a> {
    /// Z, the size of the latent.
    pub(crate) latent: i64,
    /// P, the size of proprioception.
    pub(crate) proprioception: i64,
    /// Initial mean of the action, `[A]`.
    pub(crate) pose: &'a [f32],
    /// The section `network` of the experiment.
    pub(crate) network: &'a Network,
}
