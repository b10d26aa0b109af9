//! The new policy of a transfer: it gives latents to a frozen low level.

use comic_experiment::{Network, TaskSpec, Transfer};
use tch::{Tensor, nn};

use crate::gaussian::DiagonalGaussian;
use crate::layers::{GaussianHeadConfig, GaussianMlp};

/// π(z_t | x_t, s_t): `[x, s]` → torso of the encoder's sizes → mean and σ of the latent. The mean is `mean_scale` · tanh,
/// since a low level knows latents near N(0, I) only.
#[derive(Debug)]
pub(crate) struct HighLevel {
    mlp: GaussianMlp,
    mean_scale: f64,
}

impl HighLevel {
    /// `image_features` is the number of image features that follow the task observation; 0 without an image.
    pub(crate) fn new(
        path: &nn::Path,
        spec: &TaskSpec,
        image_features: i64,
        network: &Network,
        transfer: &Transfer,
    ) -> Self {
        let input = (spec.task + spec.proprioception) as i64 + image_features;
        let start = vec![0.0; spec.action];
        let mlp = GaussianMlp::new(path, input, &network.encoder, &GaussianHeadConfig::of_actions(&start, network));
        Self { mlp, mean_scale: transfer.mean_scale() }
    }

    /// From `[N, X+P]` to Gaussians `[N, Z]`.
    pub(crate) fn forward(&self, input: &Tensor) -> DiagonalGaussian {
        let DiagonalGaussian { mean, std } = self.mlp.forward(input);
        DiagonalGaussian { mean: mean.tanh() * self.mean_scale, std }
    }
}
