//! Networks, multipliers and optimiser, stepped together.

use comic_experiment::{Experiment, Prior, TaskSpec};
use comic_networks::{Acting, ActionDistribution, NormaliserStatistics, Policy, RecurrentState, Value, to_safetensors};
use comic_proto::{Field, UnrollShape};
use tch::{Device, Kind, Tensor, nn};

use crate::adam::{self, Adam};
use crate::algorithm::Algorithm;
use crate::algorithm::error::Error;
use crate::algorithm::losses::Losses;
use crate::algorithm::minibatch::MinibatchTensors;
use crate::algorithm::shape::MinibatchShape;
use crate::vmpo::improvement::{Evidence, Improvement, KlLimits, masked_mean, policy_improvement};
use crate::vmpo::multipliers::Multipliers;
use crate::vmpo::returns::returns;
use crate::vmpo::stores::{named, trainable};

/// The online networks, the multipliers and Adam.
///
/// Nothing here is random after construction: the latent's noise comes with the unrolls. So state and minibatches decide
/// every later parameter, bit for bit on a CPU with the same number of threads.
#[derive(Debug)]
pub struct VmpoLearner {
    spec: TaskSpec,
    experiment: Experiment,
    policy_store: nn::VarStore,
    value_store: nn::VarStore,
    policy: Policy,
    value: Value,
    multipliers: Multipliers,
    adam: Adam,
    networks_group: usize,
    multipliers_group: usize,
}

/// One forward pass over a minibatch; N = B·T rows.
struct Pass {
    acting: Acting,
    /// As stored, over N rows.
    behaviour: ActionDistribution,
    /// V(s_t), `[N, R]`, with gradient.
    values: Tensor,
    /// G_t, `[N, R]`.
    targets: Tensor,
    /// Steps that are learnt from, `[N]`.
    valid: Tensor,
    /// The steps that each E-step ranks, `[N]` booleans; together all of them.
    groups: Vec<Tensor>,
    /// Fraction of the rows that are transitions.
    valid_share: Tensor,
    /// ½ mean (V − G)², summed over the reward terms.
    value_loss: Tensor,
    /// Mean KL to the prior, nats a step.
    latent_kl: Tensor,
}

/// The result of applying gradients.
struct Descent {
    /// Global norm of the networks' gradients before clipping.
    norm: Tensor,
    /// Whether the step was taken, a boolean scalar.
    finite: Tensor,
}

impl VmpoLearner {
    /// New networks on `device`. Their first values come from libtorch's generator on the CPU, so after `tch::manual_seed`
    /// they are the same on every device. `pose` is the action at which the policy's mean starts, A entries.
    ///
    /// # Errors
    /// [`Error::Networks`] when `pose` is no action of this task.
    pub fn new(spec: &TaskSpec, experiment: &Experiment, pose: &[f32], device: Device) -> Result<Self, Error> {
        let host = Self::made_on(Device::Cpu, spec, experiment, pose)?;
        if device == Device::Cpu {
            return Ok(host);
        }
        let mut learner = Self::made_on(device, spec, experiment, pose)?;
        learner.load_state(&host.state())?;
        Ok(learner)
    }

    fn made_on(device: Device, spec: &TaskSpec, experiment: &Experiment, pose: &[f32]) -> Result<Self, Error> {
        let Experiment { network, vmpo, optimiser, .. } = experiment;
        let policy_store = nn::VarStore::new(device);
        let value_store = nn::VarStore::new(device);
        let policy = Policy::new(&policy_store.root(), spec, network, pose)?;
        let value = Value::new(&value_store.root(), spec, network);
        let temperatures = if vmpo.temperature_per_task { spec.tasks.len() } else { 1 };
        let multipliers = Multipliers::initial(vmpo, temperatures, network.components(), device);
        let mut adam = Adam::new(optimiser);
        let mut parameters = trainable("policy", &policy_store);
        parameters.extend(trainable("value", &value_store));
        let networks_group = adam.add_group("networks", parameters, optimiser.learning_rate);
        let multiplier = vec![("multipliers".to_string(), multipliers.parameter().shallow_clone())];
        let multipliers_group = adam.add_group("multipliers", multiplier, optimiser.multiplier_learning_rate);
        Ok(Self {
            spec: spec.clone(),
            experiment: experiment.clone(),
            policy_store,
            value_store,
            policy,
            value,
            multipliers,
            adam,
            networks_group,
            multipliers_group,
        })
    }

    /// The online policy's parameters: what actors need.
    pub fn policy_store(&self) -> &nn::VarStore {
        &self.policy_store
    }

    /// The online policy.
    pub fn policy(&self) -> &Policy {
        &self.policy
    }

    /// η, α_μ, α_Σ and, for a mixture, α_discrete.
    pub fn multipliers(&self) -> &Multipliers {
        &self.multipliers
    }

    /// The device of all tensors.
    pub fn device(&self) -> Device {
        self.policy_store.device()
    }

    /// Sets the learning rates of the networks and of the multipliers, until they are set again.
    pub fn set_learning_rates(&mut self, networks: f64, multipliers: f64) {
        self.adam.set_learning_rate(self.networks_group, networks);
        self.adam.set_learning_rate(self.multipliers_group, multipliers);
    }

    /// Every trained parameter's name and number of elements.
    pub fn parameter_counts(&self) -> Vec<(String, usize)> {
        let mut parameters = trainable("policy", &self.policy_store);
        parameters.extend(trainable("value", &self.value_store));
        parameters.into_iter().map(|(name, tensor)| (name, tensor.numel())).collect()
    }

    fn entries(&self) -> Vec<(String, Tensor)> {
        let mut entries = named("policy", &self.policy_store);
        entries.extend(named("value", &self.value_store));
        entries.push(("multipliers".to_string(), self.multipliers.parameter().shallow_clone()));
        entries.extend(self.adam.entries());
        entries
    }

    fn check(&self, minibatch: &MinibatchTensors) -> Result<(), Error> {
        let found = minibatch.shape();
        let unroll = UnrollShape {
            length: found.unroll.length,
            proprioception: self.spec.proprioception,
            task: self.spec.task,
            action: self.spec.action,
            latent: self.experiment.network.latent.size,
            reward_terms: self.spec.reward_terms.len(),
            image: self.spec.image,
            components: self.experiment.network.components(),
            state: self.experiment.network.state_size(),
        };
        let expected = MinibatchShape { unrolls: found.unrolls, tasks: self.spec.tasks.len(), unroll };
        let known = self.spec.clips.len();
        if found == expected && minibatch.clips() <= known {
            return Ok(());
        }
        Err(Error::Shape { expected: Box::new(expected), found: Box::new(found), clips: minibatch.clips(), known })
    }

    fn forward(&self, minibatch: &MinibatchTensors) -> Pass {
        let length = minibatch.shape().unroll.length as i64;
        let Experiment { network, vmpo, .. } = &self.experiment;
        let [proprioception, task, valid, first] =
            [Field::Proprioception, Field::Task, Field::Valid, Field::First].map(|field| &minibatch[field]);
        let observation = self.policy.normalise(proprioception, task, minibatch.image(), minibatch.routing());
        let values = self.value.forward(&observation, &minibatch[Field::Clip], first);
        let first = first.narrow(1, 0, length);
        let previous_latent = &minibatch[Field::PreviousLatent];
        let acting = self.policy.act(
            &observation.first_steps(length),
            previous_latent,
            &minibatch[Field::LatentNoise],
            RecurrentState { state: &minibatch[Field::State], first: Some(&first) },
        );
        let (reward, discount) = (&minibatch[Field::Reward], &minibatch[Field::Discount]);
        let targets = returns(reward, discount, valid, &values, vmpo.discount, vmpo.lambda);
        let (targets, values) = (rows(&targets), rows(&values.narrow(1, 0, length)));
        let valid_share = valid.mean(Kind::Float);
        let valid = self.learnt_from(valid).reshape([-1]);
        let errors = (&values - &targets).square().sum_dim_intlist(-1i64, false, Kind::Float) * 0.5;
        let prior: &Prior = &network.latent.prior;
        let latent_kl = match &acting.latent_posterior {
            Some(posterior) => posterior.kl_to_prior(prior, &rows(previous_latent), &first.reshape([-1])),
            None => valid.zeros_like(),
        };
        let [mean, std, log_weights] =
            [Field::Mean, Field::Std, Field::LogWeights].map(|field| rows(&minibatch[field]));
        Pass {
            behaviour: ActionDistribution::from_rows(&mean, &std, &log_weights),
            groups: self.groups(minibatch, &valid),
            value_loss: masked_mean(&errors, &valid),
            latent_kl: masked_mean(&latent_kl, &valid),
            acting,
            values,
            targets,
            valid,
            valid_share,
        }
    }

    /// The steps of each task, if each task has an E-step of its own; otherwise all steps.
    fn groups(&self, minibatch: &MinibatchTensors, valid: &Tensor) -> Vec<Tensor> {
        match minibatch.routing().tasks() {
            Some(tasks) if self.experiment.vmpo.temperature_per_task => {
                let length = minibatch.shape().unroll.length as i64;
                let of_rows = tasks.unsqueeze(1).expand([-1, length], false).reshape([-1]);
                (0..self.spec.tasks.len() as i64).map(|task| of_rows.eq(task)).collect()
            }
            _ => vec![valid.ones_like().to_kind(Kind::Bool)],
        }
    }

    /// `valid` without the rows that only warm up a recurrent value function.
    fn learnt_from(&self, valid: &Tensor) -> Tensor {
        let burnt = self.experiment.vmpo.value_burn_in as i64;
        if burnt == 0 {
            return valid.shallow_clone();
        }
        let valid = valid.copy();
        let _ = valid.narrow(1, 0, burnt).zero_();
        valid
    }

    /// Clips where asked to, and steps networks and multipliers if every number is finite.
    fn descend(&mut self, total: &Tensor, mut gradients: Vec<Tensor>, multipliers: Option<&[Tensor]>) -> Descent {
        // A parameter that a loss does not reach has no gradient at all.
        for (gradient, parameter) in gradients.iter_mut().zip(self.adam.parameters(self.networks_group)) {
            if !gradient.defined() {
                *gradient = parameter.detach().zeros_like();
            }
        }
        let norm = adam::global_norm(&gradients);
        // Of the squares, since Adam keeps squares: where their sum is finite, each of them is.
        let mut sum = total.detach() + norm.square();
        if let Some(multipliers) = multipliers {
            sum = &sum + adam::global_norm(multipliers).square();
        }
        let finite = sum.isfinite().all();
        let limit = self.experiment.optimiser.max_gradient_norm;
        if limit > 0.0 {
            adam::clip_by_global_norm(&mut gradients, &norm, limit);
        }
        self.adam.step(self.networks_group, &gradients, &finite);
        if let Some(multipliers) = multipliers {
            self.adam.step(self.multipliers_group, multipliers, &finite);
            self.multipliers.project();
        }
        Descent { norm, finite }
    }

    /// The report of a V-MPO step (`improvement`) or of a regression step (`regression`).
    fn report(
        &self,
        total: &Tensor,
        pass: &Pass,
        improvement: Option<&Improvement>,
        regression: Option<&Tensor>,
        descent: &Descent,
    ) -> Losses {
        tch::no_grad(|| {
            let zero = Tensor::zeros([1], (Kind::Float, self.device()));
            let of = |entry: fn(&Improvement) -> &Tensor| improvement.map_or(&zero, entry);
            let temperatures = self.multipliers.temperatures();
            let [alpha_mean, alpha_std] = [self.multipliers.alpha_mean(), self.multipliers.alpha_std()];
            let alpha_discrete = self.multipliers.alpha_discrete();
            let kl_weights = improvement.and_then(|improvement| improvement.kl_weights.as_ref());
            let std = pass.acting.action.std().mean_dim(-1i64, false, Kind::Float);
            let named = [
                // The loss that was differentiated.
                ("total_loss", total),
                // L_π, L_η and L_α.
                ("policy_loss", of(|improvement| &improvement.policy)),
                ("temperature_loss", of(|improvement| &improvement.temperature)),
                ("alpha_loss", of(|improvement| &improvement.alpha)),
                // ½ (V − G)², mean over valid steps, summed over reward terms.
                ("value_loss", &pass.value_loss),
                // 0 in a V-MPO step.
                ("regression_loss", regression.unwrap_or(&zero)),
                // KL of the latent to its prior, nats a step.
                ("latent_kl", &pass.latent_kl),
                // Mean KL_μ and KL_Σ to the behaviour policy, and that of a mixture's weights (0 for one Gaussian), nats a
                // step.
                ("kl_mean", of(|improvement| &improvement.kl_mean)),
                ("kl_std", of(|improvement| &improvement.kl_std)),
                ("kl_weights", kl_weights.unwrap_or(&zero)),
                // η after the step; the mean if there are several.
                ("temperature", &temperatures.mean(Kind::Float)),
                // α_μ, α_Σ and α_discrete (0 for one Gaussian) after the step.
                ("alpha_mean", &alpha_mean),
                ("alpha_std", &alpha_std),
                ("alpha_discrete", alpha_discrete.as_ref().unwrap_or(&zero)),
                // Mean standard deviation of the policy over valid steps and action dimensions.
                ("policy_std", &masked_mean(&std, &pass.valid)),
                // Global norm of the networks' gradients, before any clipping.
                ("gradient_norm", &descent.norm),
                // 1 − Var(G − V) / Var(G), of the return summed over reward terms.
                ("variance_explained", &variance_explained(pass)),
                // Fraction of the rows that are transitions, and in a warm start are demonstrated.
                ("valid_share", &pass.valid_share),
            ];
            Losses::pack(named, &temperatures, &descent.finite)
        })
    }
}

impl Algorithm for VmpoLearner {
    /// L = L_π + L_η + L_α + w · value loss + β · the latent's KL − the entropy bonus.
    fn step(&mut self, minibatch: &MinibatchTensors) -> Result<Losses, Error> {
        self.check(minibatch)?;
        let pass = self.forward(minibatch);
        let advantage = (&pass.targets - pass.values.detach()).sum_dim_intlist(-1i64, false, Kind::Float);
        let policy = &pass.acting.action;
        let kl_weights = policy.kl_weights(&pass.behaviour);
        let evidence = Evidence {
            log_prob: &policy.log_prob(&rows(&minibatch[Field::Action])),
            advantage: &advantage,
            kl_mean: &policy.kl_mean(&pass.behaviour),
            kl_std: &policy.kl_std(&pass.behaviour),
            kl_weights: kl_weights.as_ref(),
            valid: &pass.valid,
            groups: &pass.groups,
        };
        let Experiment { network, vmpo, .. } = &self.experiment;
        let improvement = policy_improvement(&evidence, &self.multipliers, &KlLimits::from(vmpo));
        let mut total =
            improvement.total() + &pass.value_loss * vmpo.value_weight + &pass.latent_kl * network.latent.beta;
        if vmpo.entropy != 0.0 {
            // A new tensor: an in-place sum would write over what the graph holds.
            let bonus = masked_mean(&policy.entropy(), &pass.valid) * vmpo.entropy;
            total = &total - &bonus;
        }
        let networks = self.adam.parameters(self.networks_group);
        let inputs: Vec<&Tensor> = networks.iter().chain([self.multipliers.parameter()]).collect();
        let mut gradients = Tensor::f_run_backward(&[&total], &inputs, false, false)?;
        let multipliers = gradients.split_off(networks.len());
        let descent = self.descend(&total, gradients, Some(&multipliers));
        Ok(self.report(&total, &pass, Some(&improvement), None, &descent))
    }

    /// Mean over valid steps of Σ ½ ((μ_θ − μ_stored) / initial_std)², with β times the latent's KL; the value function as
    /// in [`step`](Algorithm::step). The policy's standard deviation gets no gradient.
    fn regress(&mut self, minibatch: &MinibatchTensors) -> Result<(Losses, Tensor), Error> {
        self.check(minibatch)?;
        let pass = self.forward(minibatch);
        let Experiment { network, vmpo, .. } = &self.experiment;
        let errors = pass.acting.action.mean_error(&pass.behaviour.mean(), network.initial_std);
        let regression = masked_mean(&errors, &pass.valid);
        let total = &regression + &pass.value_loss * vmpo.value_weight + &pass.latent_kl * network.latent.beta;
        let gradients = Tensor::f_run_backward(&[&total], self.adam.parameters(self.networks_group), false, false)?;
        let descent = self.descend(&total, gradients, None);
        let shape = minibatch.shape();
        let sizes = [shape.unrolls, shape.unroll.length, shape.unroll.latent].map(|size| size as i64);
        // NaN must not stay in the demonstrations.
        let latents = pass.acting.latent.detach().reshape(sizes).nan_to_num(0.0, 0.0, 0.0);
        let losses = self.report(&total, &pass, None, Some(&regression), &descent);
        Ok((losses, latents))
    }

    fn set_normaliser(&mut self, statistics: &NormaliserStatistics) -> Result<(), Error> {
        Ok(self.policy.set_normaliser(statistics)?)
    }

    /// The multipliers keep the experiment's rate.
    fn set_learning_rate(&mut self, rate: f64) {
        self.set_learning_rates(rate, self.experiment.optimiser.multiplier_learning_rate);
    }

    fn reset_optimiser(&mut self) {
        self.adam.reset();
    }

    fn is_finite(&self) -> bool {
        let networks = self.adam.parameters(self.networks_group).iter().map(Tensor::detach);
        let parameters: Vec<Tensor> = networks.chain([self.multipliers.parameter().detach()]).collect();
        adam::global_norm(&parameters).double_value(&[]).is_finite()
    }

    fn policy_parameters(&self) -> Result<Vec<u8>, Error> {
        Ok(to_safetensors(&self.policy_store)?)
    }

    /// Both networks, the multipliers and Adam.
    fn state(&self) -> Vec<(String, Tensor)> {
        self.entries().into_iter().map(|(name, tensor)| (name, tensor.detach().to_device(Device::Cpu).copy())).collect()
    }

    fn load_state(&mut self, state: &[(String, Tensor)]) -> Result<(), Error> {
        Ok(adam::restore(self.entries(), state)?)
    }
}

/// 1 − Var(G − V) / Var(G) over the valid steps, of the return summed over its terms.
fn variance_explained(pass: &Pass) -> Tensor {
    let variance = |terms: &Tensor| {
        let total = terms.sum_dim_intlist(-1i64, false, Kind::Float);
        let mean = masked_mean(&total, &pass.valid);
        masked_mean(&(total - mean).square(), &pass.valid)
    };
    let unexplained = variance(&(&pass.targets - &pass.values));
    // The floor keeps a batch whose returns are all the same finite.
    1.0 - unexplained / variance(&pass.targets).clamp_min(1e-12)
}

/// `[B, T, D]` as rows `[B·T, D]`.
fn rows(tensor: &Tensor) -> Tensor {
    tensor.flatten(0, 1)
}
