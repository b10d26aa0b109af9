//! The low levels: from latent and proprioception to an action.
//!
//! Each low level is one file with one [`LowLevel`]; actor and learner do not depend on which one is used. A new low
//! level needs a file, a line in [`build`] and a line in [`low_level_layers`]. In the experiment's `network.rs` it
//! needs a name, its sizes, its number of components, the size of its state, and whether it works without a
//! bottleneck.

mod interface;
mod lstm;
mod mixture;
mod mlp;
mod primitives;
mod product;
mod size;

use comic_experiment::LowLevelName;
use tch::nn;

pub(crate) use interface::{Config, Input, LowLevel, Output};
pub use size::{Layer, Sizes};

/// The layers of an experiment's low level, without building it. They are all its tensors with more than one dimension,
/// except those whose names end in `biases`. The check of exported files and a benchmark use them.
pub fn low_level_layers(sizes: &Sizes<'_>) -> Vec<Layer> {
    match sizes.network.low_level {
        LowLevelName::Mlp => mlp::layers(sizes),
        LowLevelName::Lstm => lstm::layers(sizes),
        LowLevelName::Mixture | LowLevelName::Product => primitives::layers(sizes),
    }
}

/// Builds the low level of an experiment, with its parameters in `path`.
pub(crate) fn build(path: &nn::Path, config: &Config<'_>) -> Box<dyn LowLevel> {
    match config.network.low_level {
        LowLevelName::Mlp => Box::new(mlp::MlpLowLevel::new(path, config)),
        LowLevelName::Lstm => Box::new(lstm::LstmLowLevel::new(path, config)),
        LowLevelName::Mixture => Box::new(mixture::MixtureLowLevel::new(path, config)),
        LowLevelName::Product => Box::new(product::ProductLowLevel::new(path, config)),
    }
}
