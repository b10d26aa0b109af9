//! The reference encoder.

use comic_experiment::{Network, TaskSpec};
use tch::{Tensor, nn};

use crate::gaussian::DiagonalGaussian;
use crate::layers::{GaussianHeadConfig, Mlp, Torso, gaussian};
use crate::linear::{Linear, Matrix};
use crate::routing::{PerTask, Routing};

/// q(z_t | x_t, s_t, z_{t−1}), one network per task: `[x, s, z_{t−1}]` → torso → mean and σ of z. An optional linear
/// path goes from input to output; its weights start at 0 (CoMic supplement 2.1).
///
/// Mixture and product can work without a bottleneck. Then the output is not z but the logits of the K weights, and
/// nothing is sampled.
#[derive(Debug)]
pub(crate) struct Encoder {
    networks: PerTask,
    head: Head,
}

#[derive(Debug)]
enum Head {
    Latent { min_std: f64 },
    Weights,
}

/// The encoder's output for N rows.
pub(crate) struct Encoded {
    /// The input of the low level: z_t `[N, Z]`, or the logits of the weights `[N, K]`.
    pub(crate) intent: Tensor,
    /// z_t, `[N, Z]`; `[N, 0]` without a bottleneck.
    pub(crate) latent: Tensor,
    /// The distribution of z_t; `None` without a bottleneck.
    pub(crate) posterior: Option<DiagonalGaussian>,
}

impl Encoder {
    /// `image_features` is the number of image features that follow the task observation; 0 without an image.
    pub(crate) fn new(path: &nn::Path, spec: &TaskSpec, image_features: i64, config: &Network) -> Self {
        let latent = &config.latent;
        let networks = spec.tasks.iter().map(|task| {
            let path = path / task.name.as_str();
            let input = (spec.proprioception + latent.size + task.observation) as i64 + image_features;
            let torso = Torso::new(&path, input, &config.encoder);
            if latent.size == 0 {
                let head = Linear::new(&(&path / "head"), torso.output(), config.primitives.count as i64, 1.0);
                return Mlp::new(torso, head, None);
            }
            let start = GaussianHeadConfig {
                mean: &vec![0.0; latent.size],
                initial_std: latent.initial_std,
                min_std: latent.min_std,
                scale: 1.0,
            };
            let head = start.linear(&(&path / "head"), torso.output());
            // The linear path starts at 0: raw observations reach hundreds (contact forces) and would dominate the
            // initial latent.
            let size = [2 * latent.size as i64, input];
            let linear_path =
                config.encoder_linear_path.then(|| Matrix::new(path.var("linear_path", &size, nn::Init::Const(0.0))));
            Mlp::new(torso, head, linear_path)
        });
        let head = if latent.size > 0 { Head::Latent { min_std: latent.min_std } } else { Head::Weights };
        Self { networks: PerTask::new(networks.collect()), head }
    }

    /// `input` is `[N, X+P+Z]`, `noise` `[N, Z]`. `from` is what the latent's mean is a difference from, `[N, Z]`: the mean of a
    /// prior of the state, if there is one.
    pub(crate) fn forward(&self, input: &Tensor, from: Option<&Tensor>, noise: &Tensor, routing: &Routing) -> Encoded {
        let output = self.networks.forward(input, routing);
        match self.head {
            Head::Latent { min_std } => {
                let DiagonalGaussian { mean, std } = gaussian(&output, min_std);
                let posterior = DiagonalGaussian { mean: from.map_or(mean.shallow_clone(), |from| from + &mean), std };
                let latent = posterior.sample(noise);
                Encoded { intent: latent.shallow_clone(), latent, posterior: Some(posterior) }
            }
            Head::Weights => {
                let latent = input.narrow(1, 0, 0);
                Encoded { intent: output, latent, posterior: None }
            }
        }
    }
}
