//! The reference encoder.

use comic_experiment::Network;
use tch::{Kind, Tensor, nn};

use crate::DiagonalGaussian;
use crate::layers::{GaussianHead, GaussianHeadConfig, Torso, linear};

/// q(z_t | x_t, s_t, z_{t−1}): `[x, s, z_{t−1}]` → torso → mean and σ of z, with an optional linear path from input to
/// output whose weights start at 0 (CoMic supplement 2.1).
///
/// Without a bottleneck, which mixture and product may do without, it gives the K weights' logits in z's place and knows
/// no chance.
#[derive(Debug)]
pub(crate) struct Encoder {
    torso: Torso,
    head: Head,
}

#[derive(Debug)]
enum Head {
    Latent(GaussianHead),
    Weights(nn::Linear),
}

/// What the encoder gives, for N rows.
pub(crate) struct Encoded {
    /// What the low level is told: z_t, or the weights' logits.
    pub(crate) intent: Tensor,
    /// z_t, `[N, Z]`; `[N, 0]` without a bottleneck.
    pub(crate) latent: Tensor,
    /// Where z_t was drawn from; none without a bottleneck.
    pub(crate) posterior: Option<DiagonalGaussian>,
}

impl Encoder {
    /// `input` is the width of `[x, s, z_{t−1}]`.
    pub(crate) fn new(path: &nn::Path, input: i64, config: &Network) -> Self {
        let torso = Torso::new(path, input, &config.encoder);
        let latent = &config.latent;
        let head = if latent.size > 0 {
            let start = GaussianHeadConfig {
                mean: &vec![0.0; latent.size],
                initial_std: latent.initial_std,
                min_std: latent.min_std,
                scale: 1.0,
                linear_path: config.encoder_linear_path.then_some(input),
            };
            Head::Latent(GaussianHead::new(path, torso.output(), &start))
        } else {
            Head::Weights(linear(&(path / "head"), torso.output(), config.primitives.count as i64, 1.0))
        };
        Self { torso, head }
    }

    /// `input [N, X+P+Z]`, `noise [N, Z]`.
    pub(crate) fn forward(&self, input: &Tensor, noise: &Tensor) -> Encoded {
        let hidden = self.torso.forward(input);
        match &self.head {
            Head::Latent(head) => {
                let posterior = head.forward(&hidden, input);
                let latent = posterior.sample(noise);
                Encoded { intent: latent.shallow_clone(), latent, posterior: Some(posterior) }
            }
            Head::Weights(head) => {
                let latent = Tensor::zeros([input.size()[0], 0], (Kind::Float, input.device()));
                Encoded { intent: hidden.apply(head), latent, posterior: None }
            }
        }
    }
}
