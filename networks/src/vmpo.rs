//! The policy of V-MPO: a reference encoder and a low level, or, in transfer, a high level.

use comic_experiment::{Experiment, Network, Prior, TaskSpec, Transfer};
use tch::{Tensor, nn};

use crate::action::ActionDistribution;
use crate::encoder::Encoder;
use crate::error::Error;
use crate::high_level::HighLevel;
use crate::image_encoder::ImageEncoder;
use crate::layers::rows;
use crate::low_level::{self, Layer, LowLevel, Sizes, low_level_layers};
use crate::lstm::RecurrentState;
use crate::normaliser::{NormalisedObservation, Normaliser, NormaliserStatistics};
use crate::policy::{self, Acting, Policy, Weights};
use crate::prior::StatePrior;
use crate::routing::Routing;
use crate::weights::{self, hidden, image_features};

/// Largest standard deviation that a schedule can set, as the experiment's check has it.
const LARGEST_STD: f64 = 1e3;

/// The reference encoders q(z_t | x_t, s_t, z_{t−1}) and the low level π(a_t | s_t, z_t) (CoMic supplement; sizes in
/// [`Network`]). In joint training each task has its own encoder, and all share the low level. In transfer there is a high
/// level alone, whose action is the latent of a frozen low level.
#[derive(Debug)]
pub struct VmpoPolicy {
    normaliser: Normaliser,
    image_encoder: Option<ImageEncoder>,
    head: Head,
    /// σ of every action, `[1]`, if a schedule sets it. It is published with the parameters, and is not trained.
    scheduled_std: Option<Tensor>,
    /// Least standard deviation of an action, also of one that a file brings.
    min_std: f64,
}

/// What turns normalised observations into a distribution of actions.
#[derive(Debug)]
enum Head {
    /// A latent, and from it the action.
    LowLevel { encoder: Encoder, prior: Option<StatePrior>, low_level: Box<dyn LowLevel> },
    /// In transfer: the action is the latent of a frozen low level.
    HighLevel(HighLevel),
}

/// Makes policies of V-MPO.
#[derive(Debug)]
pub(crate) struct Builder;

impl policy::Builder for Builder {
    fn policy(
        &self,
        store: &nn::Path,
        spec: &TaskSpec,
        experiment: &Experiment,
        pose: &[f32],
    ) -> Result<Box<dyn Policy>, Error> {
        Ok(Box::new(VmpoPolicy::of(store, spec, experiment, pose)?))
    }

    fn weights(&self, spec: &TaskSpec, experiment: &Experiment) -> Weights {
        let network = &experiment.network;
        let image = if spec.image > 0 { ImageEncoder::weights(network.image_features) } else { 0 };
        if experiment.transfer.is_on() {
            return Weights { low_level: 0, prior: 0, rest: image + high_level_weights(spec, network) };
        }
        let encoders: u64 = spec.tasks.iter().map(|task| encoder_weights(spec, task.observation, network)).sum();
        let sizes = Sizes { proprioception: spec.proprioception, actions: spec.action, network };
        Weights {
            low_level: low_level_layers(&sizes).into_iter().map(Layer::weights).sum(),
            rest: image + encoders,
            prior: match &network.latent.prior {
                Prior::State { hidden } => weights::prior(spec, network, hidden),
                Prior::Standard | Prior::Ar1 { .. } => 0,
            },
        }
    }
}

impl VmpoPolicy {
    /// The policy of this experiment; everything else as in [`new`](Self::new). In transfer `pose` is not used.
    ///
    /// # Errors
    /// [`Error::Length`] if `pose` is not an action of this task.
    pub fn of(store: &nn::Path, spec: &TaskSpec, experiment: &Experiment, pose: &[f32]) -> Result<Self, Error> {
        let Experiment { network, transfer, .. } = experiment;
        if transfer.is_on() {
            return Ok(Self::of_transfer(store, spec, network, transfer));
        }
        Self::new(store, spec, network, pose)
    }

    /// Creates the policy's parameters in `store`. `pose` is the initial mean of the action, A entries in [−1, 1]; 0 is
    /// the middle of a joint's range.
    ///
    /// # Errors
    /// [`Error::Length`] if `pose` is not an action of this task.
    pub fn new(store: &nn::Path, spec: &TaskSpec, config: &Network, pose: &[f32]) -> Result<Self, Error> {
        if pose.len() != spec.action {
            return Err(Error::Length { name: "initial pose", expected: spec.action, found: pose.len() });
        }
        let proprioception = spec.proprioception as i64;
        let (image_encoder, image_features) = encode_images(store, spec, config);
        let latent = config.latent.size as i64;
        let encoder = Encoder::new(&(store / "encoder"), spec, image_features, config);
        let low_level = low_level::Config { latent, proprioception, pose, network: config };
        let low_level = low_level::build(&(store / "low_level"), &low_level);
        let prior = match &config.latent.prior {
            Prior::State { hidden } => Some(StatePrior::new(&(store / "prior"), spec.proprioception, config, hidden)),
            Prior::Standard | Prior::Ar1 { .. } => None,
        };
        let head = Head::LowLevel { encoder, prior, low_level };
        Ok(Self::assemble(store, "low_level", spec, config, image_encoder, head))
    }

    fn of_transfer(store: &nn::Path, spec: &TaskSpec, config: &Network, transfer: &Transfer) -> Self {
        let (image_encoder, image_features) = encode_images(store, spec, config);
        let high_level = HighLevel::new(&(store / "high_level"), spec, image_features, config, transfer);
        Self::assemble(store, "high_level", spec, config, image_encoder, Head::HighLevel(high_level))
    }

    /// `acting` is the path of the part that decides on the action.
    fn assemble(
        store: &nn::Path,
        acting: &str,
        spec: &TaskSpec,
        config: &Network,
        image_encoder: Option<ImageEncoder>,
        head: Head,
    ) -> Self {
        let normaliser = Normaliser::new(&(store / "normaliser"), spec, config.normaliser_steps > 0);
        let scheduled_std = (config.final_std > 0.0).then(|| (store / acting).zeros_no_train("scheduled_std", &[1]));
        let policy = Self { normaliser, image_encoder, head, scheduled_std, min_std: config.min_std };
        policy.set_scheduled_std(config.initial_std);
        policy
    }

    /// Sets the standard deviation of every action, if the experiment schedules it (`final_std`); otherwise nothing
    /// changes.
    pub fn set_scheduled_std(&self, std: f64) {
        if let Some(scheduled) = &self.scheduled_std {
            tch::no_grad(|| {
                // Data, not a constant: XLA would compile a program for each constant.
                scheduled.shallow_clone().copy_(&Tensor::from_slice(&[std as f32]));
            });
        }
    }
}

impl Policy for VmpoPolicy {
    /// Policy and value share one image encoder, and both train it.
    fn normalise(
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

    fn act(
        &self,
        observation: &NormalisedObservation,
        previous_latent: &Tensor,
        latent_noise: &Tensor,
        recurrent: RecurrentState<'_>,
    ) -> Acting {
        let NormalisedObservation { proprioception, task, routing } = observation;
        let acting = match &self.head {
            Head::LowLevel { encoder, prior, low_level } => {
                let input = rows(&Tensor::cat(&[task, proprioception, previous_latent], -1));
                let proprioception = &rows(proprioception);
                let latent_prior = prior.as_ref().map(|prior| prior.forward(proprioception));
                let from = latent_prior.as_ref().map(|prior| &prior.mean);
                let encoded = encoder.forward(&input, from, &rows(latent_noise), routing);
                let input = low_level::Input { intent: &encoded.intent, proprioception, recurrent };
                let low_level::Output { action, state } = low_level.act(&input);
                Acting { latent: encoded.latent, action, latent_posterior: encoded.posterior, latent_prior, state }
            }
            Head::HighLevel(high_level) => Acting {
                latent: rows(latent_noise),
                action: ActionDistribution::Gaussian(
                    high_level.forward(&rows(&Tensor::cat(&[task, proprioception], -1))),
                ),
                latent_posterior: None,
                latent_prior: None,
                state: recurrent.state.shallow_clone(),
            },
        };
        match &self.scheduled_std {
            Some(std) => {
                let action = acting.action.with_std(&std.clamp(self.min_std, LARGEST_STD));
                Acting { action, ..acting }
            }
            None => acting,
        }
    }

    fn set_normaliser(&self, statistics: &NormaliserStatistics) -> Result<(), Error> {
        self.normaliser.set(statistics)
    }
}

/// The image encoder of a task with images, and the number of image features.
fn encode_images(store: &nn::Path, spec: &TaskSpec, config: &Network) -> (Option<ImageEncoder>, i64) {
    if spec.image == 0 {
        return (None, 0);
    }
    let encoder = ImageEncoder::new(&(store / "image_encoder"), config.image_features as i64);
    let features = encoder.output();
    (Some(encoder), features)
}

fn encoder_weights(spec: &TaskSpec, observation: usize, network: &Network) -> u64 {
    let latent = network.latent.size as u64;
    let input = (spec.proprioception + observation + image_features(spec, network)) as u64 + latent;
    let (weights, width) = hidden(input, &network.encoder);
    let output = if latent == 0 { network.primitives.count as u64 } else { 2 * latent };
    let path = if latent > 0 && network.encoder_linear_path { output * input } else { 0 };
    weights + width * output + path
}

fn high_level_weights(spec: &TaskSpec, network: &Network) -> u64 {
    let input = spec.proprioception + spec.task + image_features(spec, network);
    let (weights, width) = hidden(input as u64, &network.encoder);
    weights + width * 2 * spec.action as u64
}
