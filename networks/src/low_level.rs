//! The low level: from latent and proprioception to an action.
//!
//! Each is one file and one [`LowLevel`]; neither actor nor learner asks which it is. A new one is a new file, a line in
//! [`build`] and one in [`low_level_layers`]; and in the experiment's `network.rs` a name, its sizes, and what is said of it
//! there: components, numbers of state, whether it can do without a bottleneck and be taught by demonstrations.

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
