//! Everything that acts: normaliser, reference encoder, low level.

use comic_experiment::{Network, TaskSpec};
use tch::{Tensor, nn};

use crate::layers::{GaussianHead, GaussianHeadConfig, Torso, rows};
use crate::normaliser::Normaliser;
use crate::sight::Sight;
use crate::{DiagonalGaussian, Error, NormalisedObservation, NormaliserStatistics};

/// What one pass of the policy gives, for N rows.
#[derive(Debug)]
pub struct Acting {
    /// z_t = μ_θ + σ_θ·noise, `[N, Z]`.
    pub latent: Tensor,
    /// π(a_t | s_t, z_t), over `[N, A]`.
    pub action: DiagonalGaussian,
    /// q(z_t | x_t, s_t, z_{t−1}), over `[N, Z]`.
    pub latent_posterior: DiagonalGaussian,
}

/// The policy: the reference encoder q(z_t | x_t, s_t, z_{t−1}) and the low level π(a_t | s_t, z_t)
/// (CoMic supplement; sizes in [`Network`]).
///
/// - Encoder: `[x, s, z_{t−1}]` → torso → mean and σ of z, with an optional linear path from input to output
///   whose weights start at 0.
/// - Low level: `[z, s]` → torso → mean and σ of the action. The mean's bias starts at `pose`, σ at `initial_std`;
///   the head's weights are scaled by `policy_head_scale`.
#[derive(Debug)]
pub struct Policy {
    normaliser: Normaliser,
    sight: Option<Sight>,
    encoder: Torso,
    encoder_head: GaussianHead,
    low_level: Torso,
    low_level_head: GaussianHead,
}

impl Policy {
    /// Creates the policy's parameters in `store`. `pose` is the action at which the mean starts, A entries in
    /// [−1, 1]; zeros are the middle of every joint's range.
    ///
    /// # Errors
    /// [`Error::Length`] when `pose` is not an action of this task.
    pub fn new(store: &nn::Path, spec: &TaskSpec, config: &Network, pose: &[f32]) -> Result<Self, Error> {
        if pose.len() != spec.action {
            return Err(Error::Length { name: "initial pose", expected: spec.action, found: pose.len() });
        }
        let (proprioception, task) = (spec.proprioception as i64, spec.task as i64);
        let sight = (spec.image > 0).then(|| Sight::new(&(store / "sight"), config.image_features as i64));
        let seen = sight.as_ref().map_or(0, Sight::output);
        let latent = config.latent.size as i64;
        let input = task + seen + proprioception + latent;
        let encoder_path = store / "encoder";
        let encoder = Torso::new(&encoder_path, input, &config.encoder);
        let encoder_head = GaussianHead::new(
            &encoder_path,
            encoder.output(),
            &GaussianHeadConfig {
                mean: &vec![0.0; config.latent.size],
                initial_std: config.latent.initial_std,
                min_std: config.latent.min_std,
                scale: 1.0,
                linear_path: config.encoder_linear_path.then_some(input),
            },
        );
        let low_level_path = store / "low_level";
        let low_level = Torso::new(&low_level_path, latent + proprioception, &config.low_level);
        let low_level_head = GaussianHead::new(
            &low_level_path,
            low_level.output(),
            &GaussianHeadConfig {
                mean: pose,
                initial_std: config.initial_std,
                min_std: config.min_std,
                scale: config.policy_head_scale,
                linear_path: None,
            },
        );
        let normaliser = Normaliser::new(&(store / "normaliser"), proprioception, task, config.normaliser_steps > 0);
        Ok(Self { normaliser, sight, encoder, encoder_head, low_level, low_level_head })
    }

    /// Acts, or learns: proprioception `[N, P]`, task observation `[N, X]`, image `[N, I]` uint8 where the task has one,
    /// previous sampled latent `[N, Z]` (zeros at an episode's start) and standard-normal noise `[N, Z]`, all as they
    /// come from the environment.
    pub fn act(
        &self,
        proprioception: &Tensor,
        task: &Tensor,
        image: Option<&Tensor>,
        previous_latent: &Tensor,
        latent_noise: &Tensor,
    ) -> Acting {
        self.act_normalised(&self.normalise(proprioception, task, image), previous_latent, latent_noise)
    }

    /// Normalises observations of any leading dimensions: proprioception `[.., P]`, task observation `[.., X]`, image
    /// `[.., I]` uint8. What is seen in the image joins the task observation, so policy and value share one pair of eyes;
    /// both learn it.
    pub fn normalise(&self, proprioception: &Tensor, task: &Tensor, image: Option<&Tensor>) -> NormalisedObservation {
        let mut observation = self.normaliser.forward(proprioception, task);
        if let (Some(sight), Some(image)) = (&self.sight, image) {
            observation.task = Tensor::cat(&[&observation.task, &sight.forward(image)], -1);
        }
        observation
    }

    /// [`Policy::act`] on observations that are normalised already, so a learner does that once for policy and value.
    /// Any leading dimensions, the same ones for all three: `[B, T, ·]` counts as B·T rows, without a copy before the
    /// one that joins the inputs.
    pub fn act_normalised(
        &self,
        observation: &NormalisedObservation,
        previous_latent: &Tensor,
        latent_noise: &Tensor,
    ) -> Acting {
        let NormalisedObservation { proprioception, task } = observation;
        let input = rows(&Tensor::cat(&[task, proprioception, previous_latent], -1));
        let latent_posterior = self.encoder_head.forward(&self.encoder.forward(&input), &input);
        let latent = latent_posterior.sample(&rows(latent_noise));
        let input = Tensor::cat(&[&latent, &rows(proprioception)], 1);
        let action = self.low_level_head.forward(&self.low_level.forward(&input), &input);
        Acting { latent, action, latent_posterior }
    }

    /// Fixes the normaliser's statistics. They belong to the parameters that travel, and are not trained.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::Number`] when the statistics do not fit the task; nothing is changed then.
    pub fn set_normaliser(&self, statistics: &NormaliserStatistics) -> Result<(), Error> {
        self.normaliser.set(statistics)
    }
}
