//! The new policy of a transfer: it gives latents to a frozen low level.

use comic_experiment::{Network, TaskSpec, Transfer};
use tch::{Tensor, nn};

use crate::gaussian::DiagonalGaussian;
use crate::layers::{GaussianHead, GaussianHeadConfig, Torso};

/// π(z_t | x_t, s_t): `[x, s]` → torso of the encoder's sizes → mean and σ of the latent. The mean is `mean_scale` · tanh,
/// since a low level knows latents near N(0, I) only.
#[derive(Debug)]
pub(crate) struct HighLevel {
    torso: Torso,
    head: GaussianHead,
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
        let torso = Torso::new(path, (spec.task + spec.proprioception) as i64 + image_features, &network.encoder);
        let start = vec![0.0; spec.action];
        let head = GaussianHead::new(path, torso.output(), &GaussianHeadConfig::of_actions(&start, network));
        Self { torso, head, mean_scale: transfer.mean_scale() }
    }

    /// From `[N, X+P]` to Gaussians `[N, Z]`.
    pub(crate) fn forward(&self, input: &Tensor) -> DiagonalGaussian {
        let DiagonalGaussian { mean, std } = self.head.forward(&self.torso.forward(input));
        DiagonalGaussian { mean: mean.tanh() * self.mean_scale, std }
    }
}
