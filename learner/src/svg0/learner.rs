//! Online and target networks, stepped together.

use comic_experiment::{Experiment, Svg0, TaskSpec};
use comic_networks::{
    ActionValue, DiagonalGaussian, NormalisedObservation, NormaliserStatistics, Policy as _, RecurrentState,
    Svg0Policy, to_safetensors,
};
use comic_proto::Field;
use tch::{Device, Kind, Tensor, nn};

use crate::adam::{self, Adam};
use crate::algorithm::descent::{Gradients, descend};
use crate::algorithm::error::Error;
use crate::algorithm::loss_report::Losses;
use crate::algorithm::masked_mean::masked_mean;
use crate::algorithm::minibatch::MinibatchTensors;
use crate::algorithm::stores::{named, trainable};
use crate::algorithm::{Algorithm, made_on};
use crate::svg0::retrace::{Trace, retrace};

/// Online and target networks, and Adam.
///
/// The noise of a gradient step depends on the experiment's seed and on the number of steps so far. So state and minibatches
/// decide every later parameter.
#[derive(Debug)]
pub struct Svg0Learner {
    spec: TaskSpec,
    experiment: Experiment,
    online: Networks,
    target: Networks,
    adam: Adam,
    group: usize,
    /// Gradient steps so far.
    steps: u64,
}

/// A policy and an action value with a common core.
#[derive(Debug)]
struct Networks {
    policy_store: nn::VarStore,
    value_store: nn::VarStore,
    policy: Svg0Policy,
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
    fn new(device: Device, spec: &TaskSpec, experiment: &Experiment) -> Self {
        let (policy_store, value_store) = (nn::VarStore::new(device), nn::VarStore::new(device));
        let policy = Svg0Policy::new(&policy_store.root(), spec, experiment);
        let action_value = ActionValue::new(&value_store.root(), spec, &experiment.svg0);
        Self { policy_store, value_store, policy, action_value }
    }

    /// Every parameter, by name.
    fn entries(&self, prefix: &str) -> Vec<(String, Tensor)> {
        let mut entries = named(&format!("{prefix}policy"), &self.policy_store);
        entries.extend(named(&format!("{prefix}value"), &self.value_store));
        entries
    }

    /// Takes the parameters of `other`.
    fn copy_from(&self, other: &Self) {
        tch::no_grad(|| {
            for ((_, own), (_, other)) in self.entries("").into_iter().zip(other.entries("")) {
                own.shallow_clone().copy_(&other);
            }
        });
    }

    /// The networks from row `burn_in` on. The rows before it only build up the recurrent states, without gradient.
    fn pass(&self, minibatch: &MinibatchTensors, burn_in: i64) -> Pass {
        let (core, policy) = (self.policy.core(), self.policy.latent_policy());
        let (proprioception, task) = (&minibatch[Field::Proprioception], &minibatch[Field::Task]);
        let observation = self.policy.normalise(proprioception, task, minibatch.image(), minibatch.routing());
        let (first, state) = (&minibatch[Field::First], &minibatch[Field::State]);
        let own = core.state_size();
        let mut states = [state.narrow(1, 0, own), state.narrow(1, own, policy.state_size())];
        if burn_in > 0 {
            states = tch::no_grad(|| {
                let first = first.narrow(1, 0, burn_in);
                let recurrent = RecurrentState { state: &states[0], first: Some(&first) };
                let (features, core_state) = core.forward(&observation.steps(0, burn_in), recurrent);
                let recurrent = RecurrentState { state: &states[1], first: Some(&first) };
                [core_state, policy.forward(&features, recurrent).1]
            });
        }
        let rows = first.size()[1] - burn_in;
        let first = first.narrow(1, burn_in, rows);
        let observation: NormalisedObservation = observation.steps(burn_in, rows);
        let recurrent = RecurrentState { state: &states[0], first: Some(&first) };
        let (features, _) = core.forward(&observation, recurrent);
        // The critic alone trains the core.
        let recurrent = RecurrentState { state: &states[1], first: Some(&first) };
        let (policy, _) = policy.forward(&features.detach(), recurrent);
        Pass { features, policy }
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

impl Svg0Learner {
    /// New networks on `device`. Their first values come from libtorch's generator on the CPU, so after `tch::manual_seed` they are
    /// the same on every device.
    ///
    /// # Errors
    /// [`Error::Networks`] when the networks cannot be made.
    pub fn new(spec: &TaskSpec, experiment: &Experiment, device: Device) -> Result<Self, Error> {
        made_on(device, |device| Ok(Self::make(device, spec, experiment)))
    }

    fn make(device: Device, spec: &TaskSpec, experiment: &Experiment) -> Self {
        let online = Networks::new(device, spec, experiment);
        let mut target = Networks::new(device, spec, experiment);
        target.copy_from(&online);
        target.policy_store.freeze();
        target.value_store.freeze();
        let mut adam = Adam::new(&experiment.optimiser);
        let mut parameters = trainable("policy", &online.policy_store);
        parameters.extend(trainable("value", &online.value_store));
        let group = adam.add_group("networks", parameters, experiment.optimiser.learning_rate);
        Self { spec: spec.clone(), experiment: experiment.clone(), online, target, adam, group, steps: 0 }
    }

    /// Standard-normal noise of this gradient step, `[2, J, N, Z]`: for the target's values and for the policy's gradient.
    fn noise(&self, rows: i64) -> Tensor {
        tch::manual_seed(comic_experiment::seed::derive(self.experiment.seed, self.steps).cast_signed());
        let samples = self.experiment.svg0.action_samples as i64;
        let noise = Tensor::randn([2, samples, rows, self.spec.action as i64], (Kind::Float, Device::Cpu));
        noise.to_device(self.online.policy_store.device())
    }

    fn entries(&self) -> Vec<(String, Tensor)> {
        let mut entries = self.online.entries("");
        entries.extend(self.target.entries("target_"));
        entries.extend(self.adam.entries());
        entries
    }
}

/// The name of the number of gradient steps in the state.
const STEPS: &str = "gradient_steps";

impl Algorithm for Svg0Learner {
    /// L = L_Q + L_π, where L_Q = ½ mean (Q(h_t, z_t) − Q^ret_t)² and
    /// L_π = −mean [mean_j Q′(h′_t, z^j) + c_H H(π)] + c_KL mean KL(π ‖ N(0, I)).
    fn step(&mut self, minibatch: &MinibatchTensors) -> Result<Losses, Error> {
        minibatch.check(&self.spec, &self.experiment)?;
        let Svg0 { discount, lambda, entropy, kl, burn_in, .. } = self.experiment.svg0;
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
        let noise = self.noise(unrolls * rows);

        let online = self.online.pass(minibatch, burn_in);
        let divergence = online.policy.kl_to_standard_normal();
        let (targets, trace, target_features) = tch::no_grad(|| {
            let target = self.target.pass(minibatch, burn_in);
            let features = target.features.flatten(0, 1);
            let value = self.target.expected_action_value(&features, &target.policy, &noise.select(0, 0));
            let value = (value - divergence.detach() * kl).reshape([unrolls, rows]);
            let features = without_last(&features);
            let policy =
                DiagonalGaussian { mean: without_last(&target.policy.mean), std: without_last(&target.policy.std) };
            let ratio = (policy.log_prob(&action) - behaviour.log_prob(&action)).clamp_max(0.0).exp();
            let coefficient = (ratio * lambda).reshape([unrolls, steps]);
            let targets = retrace(&Trace {
                reward: &learned(Field::Reward).sum_dim_intlist(-1i64, false, Kind::Float),
                discount: &(learned(Field::Discount) * discount),
                action_value: &self.target.action_value.forward(&features, &action).reshape([unrolls, steps]),
                value: &value,
                coefficient: &coefficient,
                valid: &valid,
            });
            (targets.flatten(0, 1), coefficient.flatten(0, 1), features)
        });

        let mask = valid.flatten(0, 1);
        let action_value = self.online.action_value.forward(&without_last(&online.features.flatten(0, 1)), &action);
        let value_loss = masked_mean(&((&action_value - &targets).square() * 0.5), &mask);
        let policy =
            DiagonalGaussian { mean: without_last(&online.policy.mean), std: without_last(&online.policy.std) };
        let gain = self.target.expected_action_value(
            &target_features,
            &policy,
            &without_last_of_noise(&noise, unrolls, steps),
        );
        let (gain, spread) = (masked_mean(&gain, &mask), masked_mean(&policy.entropy(), &mask));
        let divergence = masked_mean(&without_last(&divergence.unsqueeze(1)).squeeze_dim(1), &mask);
        let policy_loss = &divergence * kl - &gain - &spread * entropy;
        let total = &value_loss + &policy_loss;

        let gradients = Tensor::f_run_backward(&[&total], self.adam.parameters(self.group), false, false)?;
        let gradients = Gradients::new(&self.adam, self.group, gradients);
        let norm = gradients.norm();
        let gradients = gradients.clipped(self.experiment.optimiser.max_gradient_norm);
        let finite = descend(&mut self.adam, &total, &[gradients]);
        self.steps += 1;
        if self.steps.is_multiple_of(self.experiment.svg0.target_period) {
            self.target.copy_from(&self.online);
        }
        let named = [
            ("total_loss", &total),
            ("value_loss", &value_loss),
            ("policy_loss", &policy_loss),
            ("action_value", &masked_mean(&action_value, &mask)),
            ("retrace_target", &masked_mean(&targets, &mask)),
            ("trace", &masked_mean(&trace, &mask)),
            ("entropy", &spread),
            ("latent_kl", &divergence),
            ("policy_std", &policy.std.mean(Kind::Float)),
            ("gradient_norm", &norm),
            ("valid_share", &mask.mean(Kind::Float)),
        ];
        let none = Tensor::zeros([0], (Kind::Float, mask.device()));
        Ok(Losses::pack(named, &none, &finite))
    }

    fn set_normaliser(&mut self, statistics: &NormaliserStatistics) -> Result<(), Error> {
        self.online.policy.set_normaliser(statistics)?;
        Ok(self.target.policy.set_normaliser(statistics)?)
    }

    /// Where a multiple of the period lies within the update's gradient steps.
    fn publishes_after(&self, _: u64, steps: u64) -> bool {
        let period = self.experiment.svg0.publish_period;
        self.steps / period > self.steps.saturating_sub(steps) / period
    }

    fn set_progress(&mut self, used: f64) {
        let share = self.experiment.optimiser.final_learning_rate_share;
        let rate = self.experiment.optimiser.learning_rate * (1.0 - (1.0 - share) * used.clamp(0.0, 1.0));
        self.adam.set_learning_rate(self.group, rate);
    }

    fn is_finite(&self) -> bool {
        let parameters: Vec<Tensor> = self.adam.parameters(self.group).iter().map(Tensor::detach).collect();
        adam::global_norm(&parameters).double_value(&[]).is_finite()
    }

    fn parameter_counts(&self) -> Vec<(String, usize)> {
        let mut parameters = trainable("policy", &self.online.policy_store);
        parameters.extend(trainable("value", &self.online.value_store));
        parameters.into_iter().map(|(name, tensor)| (name, tensor.numel())).collect()
    }

    fn remedies(&self) -> &'static str {
        "a lower optimiser.learning_rate, a larger svg0.target_period, and an optimiser.max_gradient_norm"
    }

    fn policy_parameters(&self) -> Result<Vec<u8>, Error> {
        Ok(to_safetensors(&self.online.policy_store)?)
    }

    fn state(&self) -> Vec<(String, Tensor)> {
        let copy = |(name, tensor): (String, Tensor)| (name, tensor.detach().to_device(Device::Cpu).copy());
        let steps = (STEPS.to_string(), Tensor::from_slice(&[self.steps as i64]));
        self.entries().into_iter().map(copy).chain([steps]).collect()
    }

    fn load_state(&mut self, state: &[(String, Tensor)]) -> Result<(), Error> {
        let steps = Tensor::zeros([1], (Kind::Int64, Device::Cpu));
        let mut entries = self.entries();
        entries.push((STEPS.to_string(), steps.shallow_clone()));
        adam::restore(entries, state)?;
        self.steps = u64::try_from(steps.int64_value(&[0])).unwrap_or(0);
        Ok(())
    }
}

/// The noise of the policy's gradient, `[J, B·n, Z]`, from that of all rows.
fn without_last_of_noise(noise: &Tensor, unrolls: i64, steps: i64) -> Tensor {
    noise.select(0, 1).unflatten(1, [unrolls, -1]).narrow(2, 0, steps).flatten(1, 2)
}
