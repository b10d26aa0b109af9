//! Online and target networks, stepped together.

use comic_experiment::{Experiment, TaskSpec};
use comic_networks::{NormaliserStatistics, Policy as _, to_safetensors};
use tch::{Device, Kind, Tensor};

use crate::adam::{self, Adam};
use crate::algorithm::descent::{Gradients, descend, gradients_of};
use crate::algorithm::error::Error;
use crate::algorithm::loss_report::Losses;
use crate::algorithm::masked_mean::masked_mean;
use crate::algorithm::minibatch::MinibatchTensors;
use crate::algorithm::{Algorithm, made_on};
use crate::svg0::losses::{Networks, losses, noise};

/// Online and target networks, and Adam.
///
/// The noise of a gradient step depends on the experiment's seed and on the number of steps so far, those that were skipped
/// included. So state and minibatches decide every later parameter.
#[derive(Debug)]
pub struct Svg0Learner {
    spec: TaskSpec,
    experiment: Experiment,
    online: Networks,
    target: Networks,
    adam: Adam,
    /// What the critic trains: image encoder, core and action value.
    critic: usize,
    /// The policy on the core's features.
    policy: usize,
    /// Gradient steps so far, those that were skipped included. The device counts those that were taken.
    steps: u64,
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
        target.copy_from(&online, &Tensor::from(true).to_device(device));
        target.freeze();
        let mut adam = Adam::new(&experiment.optimiser);
        let (policy, critic) =
            online.trainable().into_iter().partition(|(name, _)| name.starts_with("policy.latent_policy."));
        let rate = experiment.optimiser.learning_rate;
        let [critic, policy] =
            [("critic", critic), ("policy", policy)].map(|(name, parameters)| adam.add_group(name, parameters, rate));
        Self { spec: spec.clone(), experiment: experiment.clone(), online, target, adam, critic, policy, steps: 0 }
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
    fn step(&mut self, minibatch: &MinibatchTensors) -> Result<Losses, Error> {
        minibatch.check(&self.spec, &self.experiment)?;
        let Experiment { seed, svg0, optimiser, .. } = &self.experiment;
        let noise = noise(*seed, self.steps, minibatch, svg0);
        let terms = losses(&self.online, &self.target, minibatch, &noise, svg0);
        let total = terms.total();
        let [critic, policy] = [self.critic, self.policy].map(|group| self.adam.parameters(group));
        let parameters: Vec<&Tensor> = critic.iter().chain(policy).collect();
        let mut critic_gradients = gradients_of(&total, &parameters)?;
        let policy_gradients = critic_gradients.split_off(critic.len());
        // Each has its own limit: a large error of the critic does not slow down the policy.
        let critic = Gradients::new(self.critic, critic_gradients);
        let policy = Gradients::new(self.policy, policy_gradients);
        let norms = [critic.norm(), policy.norm()];
        let limit = optimiser.max_gradient_norm;
        let period = svg0.target_period as i64;
        let finite = descend(&mut self.adam, &total, &[critic.clipped(limit), policy.clipped(limit)])?;
        self.steps += 1;
        // On the device, so that nothing waits for it: the steps that were taken decide.
        let due = self.adam.steps(self.critic).remainder(period).eq(0).logical_and(&finite);
        self.target.copy_from(&self.online, &due);
        let named = [
            ("total_loss", &total),
            ("value_loss", &terms.value_loss),
            ("policy_loss", &terms.policy_loss),
            ("action_value", &masked_mean(&terms.action_value, &terms.valid)),
            ("retrace_target", &masked_mean(&terms.target, &terms.valid)),
            ("trace", &masked_mean(&terms.trace, &terms.valid)),
            ("entropy", &terms.entropy),
            ("latent_kl", &terms.latent_kl),
            ("policy_std", &terms.std.mean(Kind::Float)),
            ("critic_gradient_norm", &norms[0]),
            ("policy_gradient_norm", &norms[1]),
            ("valid_share", &terms.valid.mean(Kind::Float)),
        ];
        let none = Tensor::zeros([0], (Kind::Float, total.device()));
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
        for group in [self.critic, self.policy] {
            self.adam.set_learning_rate(group, rate);
        }
    }

    fn is_finite(&self) -> bool {
        let parameters: Vec<Tensor> = self.online.trainable().iter().map(|(_, tensor)| tensor.detach()).collect();
        adam::global_norm(&parameters).double_value(&[]).is_finite()
    }

    fn parameter_counts(&self) -> Vec<(String, usize)> {
        self.online.trainable().into_iter().map(|(name, tensor)| (name, tensor.numel())).collect()
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
