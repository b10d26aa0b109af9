//! The policy: normaliser, image encoder, and what decides: reference encoder and low level, or a transfer's high level.

use comic_experiment::{Experiment, Network, TaskSpec, Transfer, TransferAlgorithm};
use tch::{Tensor, nn};

use crate::action::ActionDistribution;
use crate::encoder::Encoder;
use crate::error::Error;
use crate::gaussian::DiagonalGaussian;
use crate::high_level::HighLevel;
use crate::image_encoder::ImageEncoder;
use crate::layers::rows;
use crate::low_level::{self, LowLevel};
use crate::lstm::RecurrentState;
use crate::normaliser::{NormalisedObservation, Normaliser, NormaliserStatistics};
use crate::routing::Routing;
use crate::svg0::{Core, LatentPolicy};

/// Largest standard deviation that a schedule can set, as the experiment's check has it.
const LARGEST_STD: f64 = 1e3;

/// The output of the policy for N rows.
#[derive(Debug)]
pub struct Acting {
    /// z_t = μ_θ + σ_θ·noise, `[N, Z]`; `[N, 0]` without a bottleneck.
    pub latent: Tensor,
    /// π(a_t | s_t, z_t), over N rows.
    pub action: ActionDistribution,
    /// q(z_t | x_t, s_t, z_{t−1}), over `[N, Z]`; `None` without a bottleneck.
    pub latent_posterior: Option<DiagonalGaussian>,
    /// The recurrent state after the last row of each unroll, `[B, S]`.
    pub state: Tensor,
}

/// The policy: the reference encoders q(z_t | x_t, s_t, z_{t−1}) and the low level π(a_t | s_t, z_t) (CoMic supplement;
/// sizes in [`Network`]). In joint training each task has its own encoder, and all share the low level.
#[derive(Debug)]
pub struct Policy {
    normaliser: Normaliser,
    image_encoder: Option<ImageEncoder>,
    decides: Decides,
    /// σ of every action, `[1]`, if a schedule sets it. It is published with the parameters, and is not trained.
    scheduled_std: Option<Tensor>,
    /// Least standard deviation of an action, also of one that a file brings.
    min_std: f64,
}

/// What turns normalised observations into a distribution of actions.
#[derive(Debug)]
enum Decides {
    /// A latent, and from it the action.
    Skills { encoder: Encoder, low_level: Box<dyn LowLevel> },
    /// In transfer with V-MPO: the action is the latent of a frozen low level.
    Latents(HighLevel),
    /// With SVG(0).
    Recurrent { core: Core, policy: LatentPolicy },
}

impl Policy {
    /// The policy of this experiment; everything else as in [`new`](Self::new). In transfer its action is the latent of the
    /// frozen low level, and `pose` is not used.
    ///
    /// # Errors
    /// [`Error::Length`] if `pose` is not an action of this task.
    pub fn of(store: &nn::Path, spec: &TaskSpec, experiment: &Experiment, pose: &[f32]) -> Result<Self, Error> {
        let Experiment { network, transfer, .. } = experiment;
        match transfer.algorithm {
            TransferAlgorithm::Svg0 => Ok(Self::of_svg0(store, spec, experiment)),
            TransferAlgorithm::Vmpo if transfer.is_on() => Ok(Self::of_transfer(store, spec, network, transfer)),
            TransferAlgorithm::Vmpo => Self::new(store, spec, network, pose),
        }
    }

    fn of_svg0(store: &nn::Path, spec: &TaskSpec, experiment: &Experiment) -> Self {
        let Experiment { network, svg0, transfer, .. } = experiment;
        let (image_encoder, image_features) = encode_images(store, spec, network);
        let core = Core::new(&(store / "core"), spec, image_features, svg0);
        let policy = LatentPolicy::new(&(store / "latent_policy"), spec, network, svg0, transfer);
        Self::assemble(store, "latent_policy", spec, network, image_encoder, Decides::Recurrent { core, policy })
    }

    /// Core and policy of SVG(0); `None` for any other policy.
    pub fn recurrent(&self) -> Option<(&Core, &LatentPolicy)> {
        match &self.decides {
            Decides::Recurrent { core, policy } => Some((core, policy)),
            Decides::Skills { .. } | Decides::Latents(_) => None,
        }
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
        let decides = Decides::Skills { encoder, low_level };
        Ok(Self::assemble(store, "low_level", spec, config, image_encoder, decides))
    }

    fn of_transfer(store: &nn::Path, spec: &TaskSpec, config: &Network, transfer: &Transfer) -> Self {
        let (image_encoder, image_features) = encode_images(store, spec, config);
        let high_level = HighLevel::new(&(store / "high_level"), spec, image_features, config, transfer);
        Self::assemble(store, "high_level", spec, config, image_encoder, Decides::Latents(high_level))
    }

    /// `acting` is the path of the part that decides on the action.
    fn assemble(
        store: &nn::Path,
        acting: &str,
        spec: &TaskSpec,
        config: &Network,
        image_encoder: Option<ImageEncoder>,
        decides: Decides,
    ) -> Self {
        let normaliser = Normaliser::new(&(store / "normaliser"), spec, config.normaliser_steps > 0);
        let scheduled_std = (config.final_std > 0.0).then(|| (store / acting).zeros_no_train("scheduled_std", &[1]));
        let policy = Self { normaliser, image_encoder, decides, scheduled_std, min_std: config.min_std };
        policy.set_scheduled_std(config.initial_std);
        policy
    }

    /// Normalises observations: proprioception `[.., P]`, task observation `[.., X]`, image `[.., I]` uint8. The
    /// leading dimensions are `[B]` or `[B, T]`; `routing` has the tasks of the B unrolls. The image features join the
    /// task observation, so policy and value share one image encoder, and both train it.
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

    /// Runs the policy on normalised observations, to act or to learn. `previous_latent` is the sampled z_{t−1}, `[..,
    /// Z]` (zeros at the start of an episode). `latent_noise` is the standard-normal noise of z_t, `[.., Z]`. All
    /// leading dimensions are equal: `[B, T]`, which are B·T rows, to learn; `[B]`, one step of B environments, to act.
    pub fn act(
        &self,
        observation: &NormalisedObservation,
        previous_latent: &Tensor,
        latent_noise: &Tensor,
        recurrent: RecurrentState<'_>,
    ) -> Acting {
        let NormalisedObservation { proprioception, task, routing } = observation;
        let acting = match &self.decides {
            Decides::Skills { encoder, low_level } => {
                let input = rows(&Tensor::cat(&[task, proprioception, previous_latent], -1));
                let encoded = encoder.forward(&input, &rows(latent_noise), routing);
                let proprioception = &rows(proprioception);
                let input = low_level::Input { intent: &encoded.intent, proprioception, recurrent };
                let low_level::Output { action, state } = low_level.act(&input);
                Acting { latent: encoded.latent, action, latent_posterior: encoded.posterior, state }
            }
            Decides::Latents(high_level) => Acting {
                latent: rows(latent_noise),
                action: ActionDistribution::Gaussian(
                    high_level.forward(&rows(&Tensor::cat(&[task, proprioception], -1))),
                ),
                latent_posterior: None,
                state: recurrent.state.shallow_clone(),
            },
            Decides::Recurrent { core, policy } => act_recurrently(core, policy, observation, latent_noise, recurrent),
        };
        match &self.scheduled_std {
            Some(std) => {
                let action = acting.action.with_std(&std.clamp(self.min_std, LARGEST_STD));
                Acting { action, ..acting }
            }
            None => acting,
        }
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

    /// Sets the statistics of the normaliser. They are published with the parameters, and are not trained.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::Number`] if the statistics do not fit the task; then nothing changes.
    pub fn set_normaliser(&self, statistics: &NormaliserStatistics) -> Result<(), Error> {
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

/// One step of every environment, or all steps of unrolls; the state is the core's, followed by the policy's.
fn act_recurrently(
    core: &Core,
    policy: &LatentPolicy,
    observation: &NormalisedObservation,
    latent_noise: &Tensor,
    recurrent: RecurrentState<'_>,
) -> Acting {
    let own = core.state_size();
    let states = [recurrent.state.narrow(1, 0, own), recurrent.state.narrow(1, own, policy.state_size())];
    let of = |state| RecurrentState { state, first: recurrent.first };
    let (features, core_state) = core.forward(&observation.with_steps(), of(&states[0]));
    let (action, policy_state) = policy.forward(&features, of(&states[1]));
    Acting {
        latent: rows(latent_noise),
        action: ActionDistribution::Gaussian(action),
        latent_posterior: None,
        state: Tensor::cat(&[core_state, policy_state], 1),
    }
}
