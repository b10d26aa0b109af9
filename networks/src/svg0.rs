//! The networks of SVG(0) (CoMic supplement 2.5): a recurrent core that action value and policy share, an action value, and a
//! recurrent policy. Sizes and what no paper says are fields of [`Svg0`].

use comic_experiment::{Experiment, Network, Svg0, TaskSpec, Transfer};
use tch::{Tensor, nn};

use crate::action::ActionDistribution;
use crate::error::Error;
use crate::gaussian::DiagonalGaussian;
use crate::layers::{GaussianHead, GaussianHeadConfig, Torso, rows};
use crate::linear::Linear;
use crate::lstm::{LstmStack, RecurrentState};
use crate::normaliser::{NormalisedObservation, Normaliser, NormaliserStatistics};
use crate::policy::{self, Acting, Policy, Weights};
use crate::resnet::ResNet;
use crate::routing::Routing;
use crate::weights::{hidden, image_features};

/// What acts: the core, which the critic trains, and the policy on its features. The action is not bounded by a low level of its
/// own: it is the latent of a frozen one, or the command.
#[derive(Debug)]
pub struct Svg0Policy {
    normaliser: Normaliser,
    image_encoder: Option<ResNet>,
    core: Core,
    policy: LatentPolicy,
}

impl Svg0Policy {
    /// Creates its parameters in `store`.
    pub fn new(store: &nn::Path, spec: &TaskSpec, experiment: &Experiment) -> Self {
        let Experiment { network, svg0, transfer, .. } = experiment;
        let features = network.image_features as i64;
        let image_encoder = (spec.image > 0).then(|| ResNet::new(&(store / "image_encoder"), features));
        Self {
            normaliser: Normaliser::new(&(store / "normaliser"), spec, network.normaliser_steps > 0),
            core: Core::new(&(store / "core"), spec, image_encoder.as_ref().map_or(0, ResNet::output), svg0),
            image_encoder,
            policy: LatentPolicy::new(&(store / "latent_policy"), spec, network, svg0, transfer),
        }
    }

    /// The core, whose features action value and policy read.
    pub fn core(&self) -> &Core {
        &self.core
    }

    /// The policy on the core's features.
    pub fn latent_policy(&self) -> &LatentPolicy {
        &self.policy
    }
}

impl Policy for Svg0Policy {
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

    /// The state is the core's, followed by the policy's.
    fn act(
        &self,
        observation: &NormalisedObservation,
        _: &Tensor,
        latent_noise: &Tensor,
        recurrent: RecurrentState<'_>,
    ) -> Acting {
        let own = self.core.state_size();
        let states = [recurrent.state.narrow(1, 0, own), recurrent.state.narrow(1, own, self.policy.state_size())];
        let of = |state| RecurrentState { state, first: recurrent.first };
        let (features, core_state) = self.core.forward(&observation.with_steps(), of(&states[0]));
        let (action, policy_state) = self.policy.forward(&features, of(&states[1]));
        Acting {
            latent: rows(latent_noise),
            action: ActionDistribution::Gaussian(action),
            latent_posterior: None,
            latent_prior: None,
            state: Tensor::cat(&[core_state, policy_state], 1),
        }
    }

    fn set_normaliser(&self, statistics: &NormaliserStatistics) -> Result<(), Error> {
        self.normaliser.set(statistics)
    }
}

/// Makes policies of SVG(0).
#[derive(Debug)]
pub(crate) struct Builder;

impl policy::Builder for Builder {
    fn policy(
        &self,
        store: &nn::Path,
        spec: &TaskSpec,
        experiment: &Experiment,
        _: &[f32],
    ) -> Result<Box<dyn Policy>, Error> {
        Ok(Box::new(Svg0Policy::new(store, spec, experiment)))
    }

    fn weights(&self, spec: &TaskSpec, experiment: &Experiment) -> Weights {
        let Svg0 { encoder, core, policy, .. } = &experiment.svg0;
        let features = image_features(spec, &experiment.network);
        let image = if spec.image > 0 { ResNet::weights(features) } else { 0 };
        let (mut weights, mut width) = (image, features as u64);
        for input in [spec.proprioception, spec.task].into_iter().filter(|input| *input > 0) {
            let (own, output) = hidden(input as u64, encoder);
            (weights, width) = (weights + own, width + output);
        }
        let lstm = |input: u64, units: u64| 4 * units * (input + units);
        let [core, policy] = [core, policy].map(|units| *units as u64);
        let head = policy * 2 * spec.action as u64;
        Weights { low_level: 0, prior: 0, rest: weights + lstm(width, core) + lstm(core, policy) + head }
    }
}

/// The core: an encoder each for proprioception, task observation and image features, concatenated, and an LSTM.
#[derive(Debug)]
pub struct Core {
    proprioception: Torso,
    task: Option<Torso>,
    /// Entries of the task observation. Image features follow them.
    task_size: i64,
    lstm: LstmStack,
}

impl Core {
    pub(crate) fn new(path: &nn::Path, spec: &TaskSpec, image_features: i64, sizes: &Svg0) -> Self {
        let encoder = |name: &str, input: i64| Torso::new(&(path / name), input, &sizes.encoder);
        let proprioception = encoder("proprioception", spec.proprioception as i64);
        let task = (spec.task > 0).then(|| encoder("task", spec.task as i64));
        let width = proprioception.output() + task.as_ref().map_or(0, Torso::output) + image_features;
        let lstm = LstmStack::new(path, width, &[sizes.core]);
        Self { proprioception, task, task_size: spec.task as i64, lstm }
    }

    /// Features h `[B, T, H]` of observations `[B, T, ·]`, and the state after the last row, `[B, S]`.
    pub fn forward(&self, observation: &NormalisedObservation, recurrent: RecurrentState<'_>) -> (Tensor, Tensor) {
        let NormalisedObservation { proprioception, task, .. } = observation;
        let steps = proprioception.size()[1];
        let mut parts = vec![self.proprioception.forward(&rows(proprioception))];
        let task = rows(task);
        if let Some(encoder) = &self.task {
            parts.push(encoder.forward(&task.narrow(1, 0, self.task_size)));
        }
        parts.push(task.narrow(1, self.task_size, task.size()[1] - self.task_size));
        let encoded = Tensor::cat(&parts, 1);
        // The trace of an exported policy must not contain the number of unrolls.
        let encoded = encoded.reshape([-1, steps, encoded.size()[1]]);
        self.lstm.forward(&encoded, recurrent)
    }

    /// Size of its state.
    pub fn state_size(&self) -> i64 {
        self.lstm.state_size()
    }
}

/// The policy on the core's features: an LSTM, and a Gaussian whose mean is bounded.
#[derive(Debug)]
pub struct LatentPolicy {
    lstm: LstmStack,
    head: GaussianHead,
    mean_scale: f64,
}

impl LatentPolicy {
    pub(crate) fn new(path: &nn::Path, spec: &TaskSpec, network: &Network, sizes: &Svg0, transfer: &Transfer) -> Self {
        let lstm = LstmStack::new(path, sizes.core as i64, &[sizes.policy]);
        let start = vec![0.0; spec.action];
        let config = GaussianHeadConfig {
            initial_std: sizes.initial_std,
            min_std: sizes.min_std,
            ..GaussianHeadConfig::of_actions(&start, network)
        };
        let head = GaussianHead::new(path, lstm.output(), &config);
        Self { lstm, head, mean_scale: transfer.mean_scale() }
    }

    /// The distribution of actions, over `[B·T, Z]`, for features `[B, T, H]`, and the state after the last row, `[B, S]`.
    pub fn forward(&self, features: &Tensor, recurrent: RecurrentState<'_>) -> (DiagonalGaussian, Tensor) {
        let (hidden, state) = self.lstm.forward(features, recurrent);
        let DiagonalGaussian { mean, std } = self.head.forward(&rows(&hidden));
        (DiagonalGaussian { mean: mean.tanh() * self.mean_scale, std }, state)
    }

    /// Size of its state.
    pub fn state_size(&self) -> i64 {
        self.lstm.state_size()
    }
}

/// Q(h, z): a hidden layer on `[h, z]`, and a linear output.
#[derive(Debug)]
pub struct ActionValue {
    torso: Torso,
    head: Linear,
}

impl ActionValue {
    /// Creates its parameters in `path`.
    pub fn new(path: &nn::Path, spec: &TaskSpec, sizes: &Svg0) -> Self {
        let torso = Torso::new(path, (sizes.core + spec.action) as i64, &sizes.action_value);
        let head = Linear::new(&(path / "head"), torso.output(), 1, 1.0);
        Self { torso, head }
    }

    /// Q `[N]` of features `[N, H]` and actions `[N, Z]`.
    pub fn forward(&self, features: &Tensor, action: &Tensor) -> Tensor {
        self.torso.forward(&Tensor::cat(&[features, action], 1)).apply(&self.head).squeeze_dim(1)
    }
}
