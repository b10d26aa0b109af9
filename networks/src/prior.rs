//! The prior of the state: which latents are likely in a pose.

use comic_experiment::Network;
use tch::{Tensor, nn};

use crate::gaussian::DiagonalGaussian;
use crate::layers::{GaussianHeadConfig, GaussianMlp};

/// Least standard deviation of an entry of the latent (D).
const MIN_STD: f64 = 1e-2;

/// p(z | s), learned with an encoder or fitted to its latents: normalised proprioception → torso → mean and σ of the latent. It
/// begins near N(0, I).
#[derive(Debug)]
pub struct StatePrior(GaussianMlp);

impl StatePrior {
    /// A prior for the latents of `network`, with its parameters in `path`. `proprioception` is P; `hidden` has at least one
    /// layer.
    pub fn new(path: &nn::Path, proprioception: usize, network: &Network, hidden: &[usize]) -> Self {
        let mean = vec![0.0; network.latent.size];
        let start = GaussianHeadConfig { mean: &mean, initial_std: 1.0, min_std: MIN_STD, scale: 0.1 };
        Self(GaussianMlp::new(path, proprioception as i64, hidden, &start))
    }

    /// The distribution of latents for normalised proprioception `[N, P]`.
    pub fn forward(&self, proprioception: &Tensor) -> DiagonalGaussian {
        self.0.forward(proprioception)
    }
}
