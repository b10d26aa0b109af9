//! The low level: from latent and proprioception to an action.
//!
//! Each is one file and one [`LowLevel`]; neither actor nor learner asks which it is. A new one is a new file, a line in
//! [`build`], and in the experiment a name, its sizes, and how many components and numbers of state it has.

mod lstm;
mod mixture;
mod mlp;
mod primitives;
mod product;

use std::fmt::Debug;

use comic_experiment::{LowLevelName, Network};
use tch::{Tensor, nn};

use crate::ActionDistribution;
use crate::lstm::Memory;

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
    pub(crate) memory: Memory<'a>,
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

/// The low level of an experiment, its parameters in `path`.
pub(crate) fn build(path: &nn::Path, config: &Config<'_>) -> Box<dyn LowLevel> {
    match config.network.low_level {
        LowLevelName::Mlp => Box::new(mlp::MlpLowLevel::new(path, config)),
        LowLevelName::Lstm => Box::new(lstm::LstmLowLevel::new(path, config)),
        LowLevelName::Mixture => Box::new(mixture::MixtureLowLevel::new(path, config)),
        LowLevelName::Product => Box::new(product::ProductLowLevel::new(path, config)),
    }
}
