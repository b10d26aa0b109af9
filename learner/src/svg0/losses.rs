//! One forward pass of the online and the target networks, and the losses: a pure function of networks, minibatch and noise.

use comic_experiment::{Experiment, Svg0, TaskSpec};
use comic_networks::{ActionValue, DiagonalGaussian, NormalisedObservation, Policy as _, RecurrentState, Svg0Policy};
use comic_proto::Field;
use tch::{Device, Kind, Tensor, nn};

use crate::algorithm::masked_mean::masked_mean;
use crate::algorithm::minibatch::MinibatchTensors;
use crate::algorithm::stores::{named, trainable};
use crate::svg0::retrace::{Trace, retrace};

/// A policy and an action value with a common core.
#[derive(Debug)]
pub struct Networks {
    pub(super) policy_store: nn::VarStore,
    value_store: nn::VarStore,
    pub(super) policy: Svg0Policy,
    action_value: ActionValue,
}

/// Networks applied to the rows of a minibatch that are learned from, and to the observation after the last one: B sequences of
/// n + 1 rows.
struct Pass {
    /// `[B, n+1, H]`.
    features: Tensor,
    /// Over `[B·(n+1), Z]`.
    policy: DiagonalGaussian,
}

impl Networks {
    /// New networks on `device`.
    pub fn new(device: Device, spec: &TaskSpec, experiment: &Experiment) -> Self {
        let (policy_store, value_store) = (nn::VarStore::new(device), nn::VarStore::new(device));
        let policy = Svg0Policy::new(&policy_store.root(), spec, experiment);
        let action_value = ActionValue::new(&value_store.root(), spec, &experiment.svg0);
        Self { policy_store, value_store, policy, action_value }
    }

    /// Every parameter, by name.
    pub fn entries(&self, prefix: &str) -> Vec<(String, Tensor)> {
        let mut entries = named(&format!("{prefix}policy"), &self.policy_store);
        entries.extend(named(&format!("{prefix}value"), &self.value_store));
        entries
    }

    /// Every parameter that is trained, by name.
    pub fn trainable(&self) -> Vec<(String, Tensor)> {
        let mut parameters = trainable("policy", &self.policy_store);
        parameters.extend(trainable("value", &self.value_store));
        parameters
    }

    /// From now on no parameter is trained.
    pub(super) fn freeze(&mut self) {
        self.policy_store.freeze();
        self.value_store.freeze();
    }

    /// Takes the parameters of `other` where `taken`, a boolean scalar on the device, is true.
    pub(super) fn copy_from(&self, other: &Self, taken: &Tensor) {
        tch::no_grad(|| {
            for ((_, own), (_, other)) in self.entries("").into_iter().zip(other.entries("")) {
                own.shallow_clone().copy_(&other.where_self(taken, &own));
            }
        });
    }

    /// The networks from row `burn_in` on. The rows before it only build up the recurrent states, without gradient.
    fn pass(&self, minibatch: &MinibatchTensors, burn_in: i64) -> Pass {
        let (core, policy) = (self.policy.core(), self.policy.latent_policy());
        let (first, state) = (&minibatch[Field::First], &minibatch[Field::State]);
        let own = core.state_size();
        let mut states = [state.narrow(1, 0, own), state.narrow(1, own, policy.state_size())];
        if burn_in > 0 {
            states = tch::no_grad(|| {
                let first = first.narrow(1, 0, burn_in);
                let recurrent = RecurrentState { state: &states[0], first: Some(&first) };
                let (features, core_state) = core.forward(&self.observation(minibatch, 0, burn_in), recurrent);
                let recurrent = RecurrentState { state: &states[1], first: Some(&first) };
                [core_state, policy.forward(&features, recurrent).1]
            });
        }
        let rows = first.size()[1] - burn_in;
        let first = first.narrow(1, burn_in, rows);
        let recurrent = RecurrentState { state: &states[0], first: Some(&first) };
        let (features, _) = core.forward(&self.observation(minibatch, burn_in, rows), recurrent);
        // The critic alone trains the core.
        let recurrent = RecurrentState { state: &states[1], first: Some(&first) };
        let (policy, _) = policy.forward(&features.detach(), recurrent);
        Pass { features, policy }
    }

    /// The normalised observations of `rows` rows from `start` on, images encoded.
    fn observation(&self, minibatch: &MinibatchTensors, start: i64, rows: i64) -> NormalisedObservation {
        let of = |tensor: &Tensor| tensor.narrow(1, start, rows);
        let [proprioception, task] = [Field::Proprioception, Field::Task].map(|field| of(&minibatch[field]));
        self.policy.normalise(&proprioception, &task, minibatch.image().map(of).as_ref(), minibatch.routing())
    }

    /// The mean over J samples of Q, `[N]`, for features `[N, H]` and actions μ + σ ε^j with noise `[J, N, Z]`.
    fn expected_action_value(&self, features: &Tensor, policy: &DiagonalGaussian, noise: &Tensor) -> Tensor {
        let (samples, width) = (noise.size()[0], features.size()[1]);
        let actions = policy.mean.unsqueeze(0) + policy.std.unsqueeze(0) * noise;
        let features = features.unsqueeze(0).expand([samples, -1, -1], false).reshape([-1, width]);
        let values = self.action_value.forward(&features, &actions.flatten(0, 1));
        values.reshape([samples, -1]).mean_dim(0i64, false, Kind::Float)
    }
}

/// The losses of a minibatch of B sequences with n learned rows each. Only the first two have gradients that are used.
#[derive(Debug)]
pub struct Terms {
    /// L_Q = ½ mean (Q(h_t, z_t) − Q^ret_t)², a scalar.
    pub value_loss: Tensor,
    /// L_π = −mean [mean_j Q′(h′_t, z^j) + c_H H(π)] + c_KL mean KL(π ‖ N(0, I)), a scalar.
    pub policy_loss: Tensor,
    /// mean H(π), a scalar.
    pub entropy: Tensor,
    /// mean KL(π ‖ N(0, I)), a scalar.
    pub latent_kl: Tensor,
    /// Q(h_t, z_t), `[B·n]`.
    pub action_value: Tensor,
    /// Q^ret_t, `[B·n]`, without gradient.
    pub target: Tensor,
    /// c_t, `[B·n]`, without gradient.
    pub trace: Tensor,
    /// σ of the online policy, `[B·n, Z]`.
    pub std: Tensor,
    /// 1 where a row has a transition, else 0, `[B·n]`. Means are over these rows.
    pub valid: Tensor,
}

impl Terms {
    /// L = L_Q + L_π. They share no parameter: the critic's gradient reaches core and action value, the policy's the rest.
    pub fn total(&self) -> Tensor {
        &self.value_loss + &self.policy_loss
    }
}

/// Standard-normal noise of gradient step number `step`, `[2, J, B·(n+1), Z]`: for the target's values and for the policy's
/// gradient. It comes from libtorch's generator on the CPU, so it is the same on every device.
pub fn noise(seed: u64, step: u64, minibatch: &MinibatchTensors, config: &Svg0) -> Tensor {
    tch::manual_seed(comic_experiment::seed::derive(seed, step).cast_signed());
    let shape = minibatch.shape();
    let rows = shape.unrolls * (shape.unroll.length + 1 - config.burn_in);
    let size = [2, config.action_samples, rows, shape.unroll.action].map(|size| size as i64);
    Tensor::randn(size, (Kind::Float, Device::Cpu)).to_device(minibatch[Field::Valid].device())
}

/// The losses of `minibatch` with the standard-normal numbers of [`noise`].
pub fn losses(
    online: &Networks,
    target: &Networks,
    minibatch: &MinibatchTensors,
    noise: &Tensor,
    config: &Svg0,
) -> Terms {
    let Svg0 { discount, lambda, entropy, kl, burn_in, .. } = *config;
    let burn_in = burn_in as i64;
    let [unrolls, length] = [minibatch.shape().unrolls, minibatch.shape().unroll.length].map(|size| size as i64);
    let (steps, rows) = (length - burn_in, length - burn_in + 1);
    let learned = |field: Field| minibatch[field].narrow(1, burn_in, steps);
    let action = learned(Field::Action).flatten(0, 1);
    let behaviour =
        DiagonalGaussian { mean: learned(Field::Mean).flatten(0, 1), std: learned(Field::Std).flatten(0, 1) };
    let valid = learned(Field::Valid);
    // From [B·(n+1), ·] to [B·n, ·]: without the observation after the last step.
    let without_last = |tensor: &Tensor| tensor.unflatten(0, [unrolls, rows]).narrow(1, 0, steps).flatten(0, 1);

    let pass = online.pass(minibatch, burn_in);
    let divergence = pass.policy.kl_to_standard_normal();
    let (targets, trace, target_features) = tch::no_grad(|| {
        let pass = target.pass(minibatch, burn_in);
        let features = pass.features.flatten(0, 1);
        let value = target.expected_action_value(&features, &pass.policy, &noise.select(0, 0));
        let value = (value - divergence.detach() * kl).reshape([unrolls, rows]);
        let features = without_last(&features);
        let policy = DiagonalGaussian { mean: without_last(&pass.policy.mean), std: without_last(&pass.policy.std) };
        let ratio = (policy.log_prob(&action) - behaviour.log_prob(&action)).clamp_max(0.0).exp();
        let coefficient = (ratio * lambda).reshape([unrolls, steps]);
        let targets = retrace(&Trace {
            reward: &learned(Field::Reward).sum_dim_intlist(-1i64, false, Kind::Float),
            discount: &(learned(Field::Discount) * discount),
            action_value: &target.action_value.forward(&features, &action).reshape([unrolls, steps]),
            value: &value,
            coefficient: &coefficient,
            valid: &valid,
        });
        (targets.flatten(0, 1), coefficient.flatten(0, 1), features)
    });

    let mask = valid.flatten(0, 1);
    let action_value = online.action_value.forward(&without_last(&pass.features.flatten(0, 1)), &action);
    let value_loss = masked_mean(&((&action_value - &targets).square() * 0.5), &mask);
    let policy = DiagonalGaussian { mean: without_last(&pass.policy.mean), std: without_last(&pass.policy.std) };
    // [J, B·n, Z].
    let noise = noise.select(0, 1).unflatten(1, [unrolls, rows]).narrow(2, 0, steps).flatten(1, 2);
    let gain = target.expected_action_value(&target_features, &policy, &noise);
    let (gain, spread) = (masked_mean(&gain, &mask), masked_mean(&policy.entropy(), &mask));
    let divergence = masked_mean(&without_last(&divergence.unsqueeze(1)).squeeze_dim(1), &mask);
    let policy_loss = &divergence * kl - &gain - &spread * entropy;
    Terms {
        value_loss,
        policy_loss,
        entropy: spread,
        latent_kl: divergence,
        action_value,
        target: targets,
        trace,
        std: policy.std,
        valid: mask,
    }
}
