//! The feed-forward low level.

use tch::{Tensor, nn};

use super::interface::{Config, Input, LowLevel, Output};
use super::size::{Layer, Sizes};
use crate::action::ActionDistribution;
use crate::layers::{GaussianHeadConfig, GaussianMlp};

/// `[z, s]` → torso (S: 2×1024) → mean and σ. The initial bias of the mean is the pose, the initial σ is `initial_std`,
/// and the initial weights of the head are scaled by `policy_head_scale`.
#[derive(Debug)]
pub(crate) struct MlpLowLevel(GaussianMlp);

impl MlpLowLevel {
    pub(crate) fn new(path: &nn::Path, config: &Config<'_>) -> Self {
        let network = config.network;
        let head = GaussianHeadConfig::of_actions(config.pose, network);
        Self(GaussianMlp::new(path, config.latent + config.proprioception, &network.mlp.hidden, &head))
    }
}

/// The layers that [`MlpLowLevel::new`] makes.
pub(super) fn layers(sizes: &Sizes<'_>) -> Vec<Layer> {
    Layer::stack(sizes.joined(), &[&sizes.network.mlp.hidden[..], &[sizes.head()]].concat())
}

impl LowLevel for MlpLowLevel {
    fn act(&self, input: &Input<'_>) -> Output {
        let joined = Tensor::cat(&[input.intent, input.proprioception], 1);
        let action = self.0.forward(&joined);
        Output { action: ActionDistribution::Gaussian(action), state: input.recurrent.state.shallow_clone() }
    }
}
