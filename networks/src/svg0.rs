//! The networks of SVG(0) (CoMic supplement 2.5): a recurrent core that action value and policy share, an action value, and a
//! recurrent policy. Sizes and what no paper says are fields of [`Svg0`].

use comic_experiment::{Network, Svg0, TaskSpec, Transfer};
use tch::{Tensor, nn};

use crate::gaussian::DiagonalGaussian;
use crate::layers::{GaussianHead, GaussianHeadConfig, Torso, linear, rows};
use crate::lstm::{LstmStack, RecurrentState};
use crate::normaliser::NormalisedObservation;

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
        let size = proprioception.size();
        let (unrolls, steps) = (size[0], size[1]);
        let mut parts = vec![self.proprioception.forward(&rows(proprioception))];
        let task = rows(task);
        if let Some(encoder) = &self.task {
            parts.push(encoder.forward(&task.narrow(1, 0, self.task_size)));
        }
        parts.push(task.narrow(1, self.task_size, task.size()[1] - self.task_size));
        let encoded = Tensor::cat(&parts, 1).reshape([unrolls, steps, -1]);
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
        let head = GaussianHead::new(path, lstm.output(), &GaussianHeadConfig::of_actions(&start, network));
        Self { lstm, head, mean_scale: transfer.mean_scale }
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
    head: nn::Linear,
}

impl ActionValue {
    /// Creates its parameters in `path`.
    pub fn new(path: &nn::Path, spec: &TaskSpec, sizes: &Svg0) -> Self {
        let torso = Torso::new(path, (sizes.core + spec.action) as i64, &sizes.action_value);
        let head = linear(&(path / "head"), torso.output(), 1, 1.0);
        Self { torso, head }
    }

    /// Q `[N]` of features `[N, H]` and actions `[N, Z]`.
    pub fn forward(&self, features: &Tensor, action: &Tensor) -> Tensor {
        self.torso.forward(&Tensor::cat(&[features, action], 1)).apply(&self.head).squeeze_dim(1)
    }
}
