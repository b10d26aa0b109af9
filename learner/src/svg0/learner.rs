//! Online and target networks, stepped together.

use comic_experiment::{Experiment, TaskSpec};
use comic_networks::{NormaliserStatistics, to_safetensors};
use comic_proto::UnrollShape;
use tch::{Device, Kind, Tensor};

use crate::adam::{self, Adam};
use crate::algorithm::Algorithm;
use crate::algorithm::error::Error;
use crate::algorithm::loss_report::Losses;
use crate::algorithm::masked_mean::masked_mean;
use crate::algorithm::minibatch::MinibatchTensors;
use crate::algorithm::shape::MinibatchShape;
use crate::svg0::losses::{Networks, losses, noise};

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

impl Svg0Learner {
    /// New networks on `device`. Their first values come from libtorch's generator on the CPU, so after `tch::manual_seed` they are
    /// the same on every device.
    ///
    /// # Errors
    /// [`Error::Networks`] when the networks cannot be made.
    pub fn new(spec: &TaskSpec, experiment: &Experiment, device: Device) -> Result<Self, Error> {
        let host = Self::made_on(Device::Cpu, spec, experiment)?;
        if device == Device::Cpu {
            return Ok(host);
        }
        let mut learner = Self::made_on(device, spec, experiment)?;
        learner.load_state(&host.state())?;
        Ok(learner)
    }

    fn made_on(device: Device, spec: &TaskSpec, experiment: &Experiment) -> Result<Self, Error> {
        let online = Networks::new(device, spec, experiment)?;
        let mut target = Networks::new(device, spec, experiment)?;
        target.copy_from(&online);
        target.freeze();
        let mut adam = Adam::new(&experiment.optimiser);
        let group = adam.add_group("networks", online.trainable(), experiment.svg0.learning_rate);
        Ok(Self { spec: spec.clone(), experiment: experiment.clone(), online, target, adam, group, steps: 0 })
    }

    fn check(&self, minibatch: &MinibatchTensors) -> Result<(), Error> {
        let found = minibatch.shape();
        let unroll = UnrollShape { length: found.unroll.length, ..UnrollShape::new(&self.spec, &self.experiment) };
        let expected = MinibatchShape { unrolls: found.unrolls, tasks: self.spec.tasks.len(), unroll };
        if found == expected {
            return Ok(());
        }
        let (clips, known) = (minibatch.clips(), self.spec.clips.len());
        Err(Error::Shape { expected: Box::new(expected), found: Box::new(found), clips, known })
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
        self.check(minibatch)?;
        let noise = noise(self.experiment.seed, self.steps, minibatch, &self.experiment.svg0);
        let terms = losses(&self.online, &self.target, minibatch, &noise, &self.experiment.svg0)?;
        let total = terms.total();

        let mut gradients = Tensor::f_run_backward(&[&total], self.adam.parameters(self.group), false, false)?;
        for (gradient, parameter) in gradients.iter_mut().zip(self.adam.parameters(self.group)) {
            // A parameter that the loss does not depend on has no gradient tensor.
            if !gradient.defined() {
                *gradient = parameter.detach().zeros_like();
            }
        }
        let norm = adam::global_norm(&gradients);
        let finite = (total.detach() + norm.square()).isfinite().all();
        let limit = self.experiment.optimiser.max_gradient_norm;
        if limit > 0.0 {
            adam::clip_by_global_norm(&mut gradients, &norm, limit);
        }
        self.adam.step(self.group, &gradients, &finite);
        self.steps += 1;
        if self.steps.is_multiple_of(self.experiment.svg0.target_period) {
            self.target.copy_from(&self.online);
        }
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
            ("gradient_norm", &norm),
            ("valid_share", &terms.valid.mean(Kind::Float)),
        ];
        let none = Tensor::zeros([0], (Kind::Float, total.device()));
        Ok(Losses::pack(named, &none, &finite))
    }

    fn regress(&mut self, _minibatch: &MinibatchTensors) -> Result<(Losses, Tensor), Error> {
        Err(Error::Unsupported("SVG(0) has no warm start"))
    }

    fn set_normaliser(&mut self, statistics: &NormaliserStatistics) -> Result<(), Error> {
        self.online.policy.set_normaliser(statistics)?;
        Ok(self.target.policy.set_normaliser(statistics)?)
    }

    fn publish_period(&self) -> u64 {
        1
    }

    fn set_progress(&mut self, used: f64) {
        let share = self.experiment.optimiser.final_learning_rate_share;
        self.set_learning_rate(self.experiment.svg0.learning_rate * (1.0 - (1.0 - share) * used.clamp(0.0, 1.0)));
    }

    fn set_learning_rate(&mut self, rate: f64) {
        self.adam.set_learning_rate(self.group, rate);
    }

    fn reset_optimiser(&mut self) {
        self.adam.reset();
    }

    fn is_finite(&self) -> bool {
        let parameters: Vec<Tensor> = self.adam.parameters(self.group).iter().map(Tensor::detach).collect();
        adam::global_norm(&parameters).double_value(&[]).is_finite()
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
