//! Everything that acts: normaliser, reference encoder, low level.

use comic_experiment::{Network, TaskSpec};
use tch::{Tensor, nn};

use crate::action::ActionDistribution;
use crate::encoder::Encoder;
use crate::error::Error;
use crate::gaussian::DiagonalGaussian;
use crate::image_encoder::ImageEncoder;
use crate::layers::rows;
use crate::low_level::{self, LowLevel};
use crate::lstm::RecurrentState;
use crate::normaliser::{NormalisedObservation, Normaliser, NormaliserStatistics};
use crate::routing::Routing;

/// What one pass of the policy gives, for N rows.
#[derive(Debug)]
pub struct Acting {
    /// z_t = μ_θ + σ_θ·noise, `[N, Z]`; `[N, 0]` without a bottleneck.
    pub latent: Tensor,
    /// π(a_t | s_t, z_t), over N rows.
    pub action: ActionDistribution,
    /// q(z_t | x_t, s_t, z_{t−1}), over `[N, Z]`; none without a bottleneck.
    pub latent_posterior: Option<DiagonalGaussian>,
    /// What is remembered after each unroll's last row, `[B, S]`.
    pub state: Tensor,
}

/// The policy: the reference encoders q(z_t | x_t, s_t, z_{t−1}) and the low level π(a_t | s_t, z_t)
/// (CoMic supplement; sizes in [`Network`]). Tasks that are learnt jointly have an encoder each and share the low level.
#[derive(Debug)]
pub struct Policy {
    normaliser: Normaliser,
    image_encoder: Option<ImageEncoder>,
    encoder: Encoder,
    low_level: Box<dyn LowLevel>,
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
        let proprioception = spec.proprioception as i64;
        let image_encoder =
            (spec.image > 0).then(|| ImageEncoder::new(&(store / "image_encoder"), config.image_features as i64));
        let image_features = image_encoder.as_ref().map_or(0, ImageEncoder::output);
        let latent = config.latent.size as i64;
        let encoder = Encoder::new(&(store / "encoder"), spec, image_features, config);
        let low_level = low_level::Config { latent, proprioception, pose, network: config };
        let low_level = low_level::build(&(store / "low_level"), &low_level);
        let normaliser = Normaliser::new(&(store / "normaliser"), spec, config.normaliser_steps > 0);
        Ok(Self { normaliser, image_encoder, encoder, low_level })
    }

    /// Normalises observations: proprioception `[.., P]`, task observation `[.., X]`, image `[.., I]` uint8, where the
    /// leading dimensions are `[B]` or `[B, T]` and the B unrolls are of the tasks that `routing` says. What is seen in the
    /// image joins the task observation, so policy and value share one pair of eyes; both learn it.
    pub fn normalise(
        &self,
        proprioception: &Tensor,
        task: &Tensor,
        image: Option<&Tensor>,
        routing: &Routing,
    ) -> NormalisedObservation {
        let mut observation = self.normaliser.forward(proprioception, task, routing);
        if let (Some(encoder), Some(image)) = (&self.image_encoder, image) {
            observation.task = Tensor::cat(&[&observation.task, &encoder.forward(image)], -1);
        }
        observation
    }

    /// Acts, or learns, on normalised observations: `previous_latent` is the sampled z_{t−1} `[.., Z]` (zeros at an
    /// episode's start), `latent_noise` the standard-normal noise that makes z_t `[.., Z]`. Leading dimensions are the same
    /// ones for all: `[B, T]`, where B is the memory's, count as B·T rows; whoever acts has a step of B environments,
    /// `[B]`.
    pub fn act(
        &self,
        observation: &NormalisedObservation,
        previous_latent: &Tensor,
        latent_noise: &Tensor,
        recurrent: RecurrentState<'_>,
    ) -> Acting {
        let NormalisedObservation { proprioception, task, routing } = observation;
        let input = rows(&Tensor::cat(&[task, proprioception, previous_latent], -1));
        let encoded = self.encoder.forward(&input, &rows(latent_noise), routing);
        let input = low_level::Input { intent: &encoded.intent, proprioception: &rows(proprioception), recurrent };
        let low_level::Output { action, state } = self.low_level.act(&input);
        Acting { latent: encoded.latent, action, latent_posterior: encoded.posterior, state }
    }

    /// Fixes the normaliser's statistics. They belong to the parameters that travel, and are not trained.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::Number`] when the statistics do not fit the task; nothing is changed then.
    pub fn set_normaliser(&self, statistics: &NormaliserStatistics) -> Result<(), Error> {
        self.normaliser.set(statistics)
    }
}
