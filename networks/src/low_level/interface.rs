//! What every low level takes and gives.

use std::fmt::Debug;

use comic_experiment::Network;
use tch::Tensor;

use crate::action::ActionDistribution;
use crate::lstm::RecurrentState;

/// π(a_t | s_t, z_t, what was before).
pub(crate) trait LowLevel: Debug + Send {
    /// Acts on B·T rows.
    fn act(&self, input: &Input<'_>) -> Output;
}

/// What a low level sees; N = B·T rows, unroll by unroll.
pub(crate) struct Input<'a> {
    /// z_t, `[N, Z]`; without a bottleneck what the encoder gives in its place, `[N, K]`.
    pub(crate) intent: &'a Tensor,
    /// s_t, `[N, P]`.
    pub(crate) proprioception: &'a Tensor,
    /// What was before.
    pub(crate) recurrent: RecurrentState<'a>,
}

/// What a low level does.
pub(crate) struct Output {
    /// Over N rows.
    pub(crate) action: ActionDistribution,
    /// What is remembered after each unroll's last row, `[B, S]`.
    pub(crate) state: Tensor,
}

/// Sizes and starting points that every low level is made with.
pub(crate) struct Config<'a> {
    /// Z.
    pub(crate) latent: i64,
    /// P.
    pub(crate) proprioception: i64,
    /// Where the action's mean starts, `[A]`.
    pub(crate) pose: &'a [f32],
    /// The experiment's section.
    pub(crate) network: &'a Network,
}
