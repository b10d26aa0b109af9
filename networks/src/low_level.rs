//! The low level: from latent and proprioception to an action.
//!
//! Each is one file and one [`LowLevel`]; neither actor nor learner asks which it is. A new one is a new file, a line in
//! [`build`] and one in [`low_level_layers`]; and in the experiment's `network.rs` a name, its sizes, and what is said of it
//! there: components, numbers of state, whether it can do without a bottleneck and be taught by demonstrations.

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

/// Sizes that a low level's layers follow from.
#[derive(Clone, Copy, Debug)]
pub struct Sizes<'a> {
    /// P.
    pub proprioception: usize,
    /// A.
    pub actions: usize,
    /// The experiment's section.
    pub network: &'a Network,
}

impl Sizes<'_> {
    /// Z + P.
    fn joined(&self) -> usize {
        self.network.latent.size + self.proprioception
    }

    /// A mean and a deviation for each action.
    fn head(&self) -> usize {
        2 * self.actions
    }
}

/// What a low level multiplies every row by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layer {
    /// A matrix.
    Dense {
        /// Numbers in.
        input: usize,
        /// Numbers out.
        output: usize,
        /// Whether the gradient flows on to what came in.
        flows_on: bool,
    },
    /// An LSTM layer.
    Lstm {
        /// Numbers in.
        input: usize,
        /// Numbers out, and in either state.
        units: usize,
    },
}

impl Layer {
    /// One matrix.
    fn dense(input: usize, output: usize) -> Self {
        Self::Dense { input, output, flows_on: true }
    }

    /// Matrices on top of one another.
    fn stack(input: usize, outputs: &[usize]) -> Vec<Self> {
        let inputs = std::iter::once(&input).chain(outputs);
        inputs.zip(outputs).map(|(input, output)| Self::dense(*input, *output)).collect()
    }

    /// Entries of its matrices.
    pub fn weights(self) -> u64 {
        match self {
            Self::Dense { input, output, .. } => input as u64 * output as u64,
            Self::Lstm { input, units } => 4 * units as u64 * (input as u64 + units as u64),
        }
    }
}

/// The layers of an experiment's low level, before it is built: a file is measured by them, and a benchmark. Of tensors with
/// more than one dimension these are all but those whose names end in `biases`.
pub fn low_level_layers(sizes: &Sizes<'_>) -> Vec<Layer> {
    match sizes.network.low_level {
        LowLevelName::Mlp => mlp::layers(sizes),
        LowLevelName::Lstm => lstm::layers(sizes),
        LowLevelName::Mixture | LowLevelName::Product => primitives::layers(sizes),
    }
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
