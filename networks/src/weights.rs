//! Counts the weights of layers without building them.

use comic_experiment::{Network, TaskSpec};

/// The number of weights of hidden layers, and the width of the last layer.
pub(crate) fn hidden(input: u64, sizes: &[usize]) -> (u64, u64) {
    sizes.iter().fold((0, input), |(weights, width), size| (weights + width * *size as u64, *size as u64))
}

/// The number of image features.
pub(crate) fn image_features(spec: &TaskSpec, network: &Network) -> usize {
    if spec.image > 0 { network.image_features } else { 0 }
}

/// The number of weights of a prior of the state with these hidden sizes.
pub(crate) fn prior(spec: &TaskSpec, network: &Network, sizes: &[usize]) -> u64 {
    let (weights, width) = hidden(spec.proprioception as u64, sizes);
    weights + width * 2 * network.latent.size as u64
}
