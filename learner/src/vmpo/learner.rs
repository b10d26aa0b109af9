//! Networks, multipliers and optimiser, stepped together.

use comic_experiment::{Experiment, Prior, TaskSpec};
use comic_networks::{
    ActionDistribution, NormaliserStatistics, Policy as _, RecurrentState, Value, VmpoPolicy, to_safetensors,
};
use comic_proto::Field;
use tch::{Device, Kind, Tensor, nn};

use crate::adam::{self, Adam};
use crate::algorithm::descent::{Gradients, descend, gradients_of};
use crate::algorithm::error::Error;
use crate::algorithm::loss_report::Losses;
use crate::algorithm::masked_mean::ValidSteps;
use crate::algorithm::minibatch::MinibatchTensors;
use crate::algorithm::stores::{named, trainable};
use crate::algorithm::{Algorithm, made_on};
use crate::vmpo::improvement::{Evidence, KlLimits, policy_improvement};
use crate::vmpo::multipliers::Multipliers;
use crate::vmpo::report::{self, Descent, Pass};
use crate::vmpo::returns::returns;
use crate::world::{self, World};

/// The online networks, the multipliers and Adam.
///
/// Nothing is random after construction, because the latent's noise comes with the unrolls. So state and minibatches decide
/// every later parameter, bit for bit on a CPU with the same number of threads.
#[derive(Debug)]
pub struct VmpoLearner {
    spec: TaskSpec,
    experiment: Experiment,
    policy_store: nn::VarStore,
    value_store: nn::VarStore,
    policy: VmpoPolicy,
    value: Value,
    multipliers: Multipliers,
    adam: Adam,
    networks_group: usize,
    multipliers_group: usize,
    world: World,
}

impl VmpoLearner {
    /// New networks on `device`. Their first values come from libtorch's generator on the CPU, so after `tch::manual_seed`
    /// they are the same on every device. `pose` is the action at which the policy's mean starts, A entries.
    ///
    /// # Errors
    /// [`Error::Networks`] when `pose` is no action of this task.
    pub fn new(spec: &TaskSpec, experiment: &Experiment, pose: &[f32], device: Device) -> Result<Self, Error> {
        made_on(device, |device| Self::make(device, spec, experiment, pose))
    }

    fn make(device: Device, spec: &TaskSpec, experiment: &Experiment, pose: &[f32]) -> Result<Self, Error> {
        let Experiment { network, vmpo, optimiser, .. } = experiment;
        let policy_store = nn::VarStore::new(device);
        let value_store = nn::VarStore::new(device);
        let policy = VmpoPolicy::of(&policy_store.root(), spec, experiment, pose)?;
        let value = Value::new(&value_store.root(), spec, network);
        let temperatures = if vmpo.temperature_per_task { spec.tasks.len() } else { 1 };
        let multipliers = Multipliers::initial(vmpo, temperatures, experiment.components(), device);
        let mut adam = Adam::new(optimiser);
        let mut parameters = trainable("policy", &policy_store);
        parameters.extend(trainable("value", &value_store));
        let networks_group = adam.add_group("networks", parameters, optimiser.learning_rate);
        let multiplier = vec![("multipliers".to_string(), multipliers.parameter().shallow_clone())];
        let multipliers_group = adam.add_group("multipliers", multiplier, optimiser.multiplier_learning_rate);
        let mut learner = Self {
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
            world: World::alone(),
        };
        learner.set_progress(0.0);
        Ok(learner)
    }

    /// This learner as a rank of `world`: its minibatches are shares of the whole.
    #[must_use]
    pub fn in_world(self, world: &World) -> Self {
        Self { world: world.clone(), ..self }
    }

    /// The online policy's parameters: what actors need.
    pub fn policy_store(&self) -> &nn::VarStore {
        &self.policy_store
    }

    /// The online policy.
    pub fn policy(&self) -> &VmpoPolicy {
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

    fn entries(&self) -> Vec<(String, Tensor)> {
        let mut entries = named("policy", &self.policy_store);
        entries.extend(named("value", &self.value_store));
        entries.push(("multipliers".to_string(), self.multipliers.parameter().shallow_clone()));
        entries.extend(self.adam.entries());
        entries
    }

    fn forward(&self, minibatch: &MinibatchTensors) -> Result<Pass, world::Error> {
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
        let learnt = self.learnt_from(valid).reshape([-1]).gt(0.5);
        let summed = |terms: &Tensor| terms.detach().sum_dim_intlist(-1i64, false, Kind::Float);
        let own = [summed(&(&targets - &values)), summed(&targets), self.group_of_rows(minibatch, &learnt)];
        // One operation, because each costs the time to reach the slowest rank.
        let of_all = self.world.gather(&Tensor::stack(&own, 1))?;
        let [advantage, returns, group] = [0, 1, 2].map(|column| of_all.select(1, column));
        let valid = ValidSteps::of_ranks(learnt, group.ge(0.0));
        let errors = (&values - &targets).square().sum_dim_intlist(-1i64, false, Kind::Float) * 0.5;
        let latent_kl = match (&acting.latent_posterior, &acting.latent_prior, &network.latent.prior) {
            (None, _, _) => errors.zeros_like(),
            (Some(posterior), Some(prior), _) => posterior.kl(prior),
            (Some(posterior), None, Prior::Ar1 { alpha }) => {
                posterior.kl_to_ar1(*alpha, &rows(previous_latent), &first.reshape([-1]))
            }
            (Some(posterior), None, _) => posterior.kl_to_standard_normal(),
        };
        let [mean, std, log_weights] =
            [Field::Mean, Field::Std, Field::LogWeights].map(|field| rows(&minibatch[field]));
        Ok(Pass {
            behaviour: ActionDistribution::from_rows(&mean, &std, &log_weights),
            group,
            value_loss: valid.mean(&errors),
            latent_kl: valid.mean(&latent_kl),
            acting,
            advantage,
            returns,
            valid,
            valid_share,
        })
    }

    /// The E-step that ranks each of this rank's steps: the number of its task, if each task has one of its own, and else 0. −1 for a
    /// step that is not `learnt` from.
    fn group_of_rows(&self, minibatch: &MinibatchTensors, learnt: &Tensor) -> Tensor {
        let group = match minibatch.routing().tasks() {
            Some(tasks) if self.experiment.vmpo.temperature_per_task => {
                let length = minibatch.shape().unroll.length as i64;
                tasks.unsqueeze(1).expand([-1, length], false).reshape([-1]).to_kind(Kind::Float)
            }
            _ => learnt.zeros_like().to_kind(Kind::Float),
        };
        group.where_scalarother(learnt, -1.0)
    }

    /// η of each of this rank's rows. A row that is not learnt from has one, too, so that it can be divided by.
    fn temperature_of_rows(&self, group: &Tensor) -> Tensor {
        let index = self.world.own_part(group).clamp_min(0.0).to_kind(Kind::Int64);
        self.multipliers.temperatures().detach().index_select(0, &index)
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

    /// Clips the networks' gradients if the experiment says so, and steps networks and multipliers if every number is finite.
    fn descend(&mut self, total: &Tensor, networks: Vec<Tensor>, multipliers: Vec<Tensor>) -> Result<Descent, Error> {
        let networks = Gradients::new(self.networks_group, networks);
        let norm = networks.norm();
        let networks = networks.clipped(self.experiment.optimiser.max_gradient_norm);
        let multipliers = Gradients::new(self.multipliers_group, multipliers);
        let finite = descend(&mut self.adam, total, &[networks, multipliers])?;
        self.multipliers.project();
        Ok(Descent { norm, finite })
    }
}

impl Algorithm for VmpoLearner {
    /// L = L_π + L_η + L_α + w · value loss + β · the latent's KL − the simulator's derivative times the mean action − the
    /// entropy bonus.
    fn step(&mut self, minibatch: &MinibatchTensors) -> Result<Losses, Error> {
        minibatch.check(&self.spec, &self.experiment)?;
        let pass = self.forward(minibatch)?;
        let policy = &pass.acting.action;
        let kl_weights = policy.kl_weights(&pass.behaviour);
        let Experiment { network, vmpo, .. } = &self.experiment;
        let kl = if vmpo.control_variate == 0.0 { None } else { policy.kl_from(&pass.behaviour) };
        let temperatures = self.multipliers.temperatures().size()[0];
        let groups: Vec<Tensor> = (0..temperatures).map(|index| pass.group.eq(index)).collect();
        let evidence = Evidence {
            kl: kl.as_ref(),
            log_prob: &policy.log_prob(&rows(&minibatch[Field::Action])),
            advantage: &pass.advantage,
            kl_mean: &policy.kl_mean(&pass.behaviour),
            kl_std: &policy.kl_std(&pass.behaviour),
            kl_weights: kl_weights.as_ref(),
            valid: &pass.valid,
            groups: &groups,
            world: &self.world,
        };
        let improvement = policy_improvement(&evidence, &self.multipliers, &KlLimits::from(vmpo));
        let mut total =
            improvement.total() + &pass.value_loss * vmpo.value_weight + &pass.latent_kl * network.latent.beta;
        if vmpo.action_gradient != 0.0 {
            let derivative = rows(&minibatch[Field::ActionGradient]);
            let gain = (derivative * policy.mean()).sum_dim_intlist(-1i64, false, Kind::Float);
            // Divided by η, as the advantages are: L_π is about the reward divided by η.
            let gain = gain / self.temperature_of_rows(&pass.group);
            total = &total - pass.valid.mean(&gain) * vmpo.action_gradient;
        }
        if vmpo.entropy != 0.0 {
            // A new tensor: an in-place sum would write over what the graph holds.
            let bonus = pass.valid.mean(&policy.entropy()) * vmpo.entropy;
            total = &total - &bonus;
        }
        let networks = self.adam.parameters(self.networks_group);
        let inputs: Vec<&Tensor> = networks.iter().chain([self.multipliers.parameter()]).collect();
        let mut gradients = gradients_of(&total, &inputs)?;
        let mut losses = report::shares(&pass, &total, &improvement, &self.world);
        self.world.sum(gradients.iter_mut().chain([&mut losses]))?;
        let multipliers = gradients.split_off(networks.len());
        let descent = self.descend(&report::total(&losses), gradients, multipliers)?;
        Ok(report::report(&losses, &descent, &self.multipliers))
    }

    fn publishes_after(&self, updates: u64, _: u64) -> bool {
        updates.is_multiple_of(self.experiment.vmpo.target_period)
    }

    fn set_normaliser(&mut self, statistics: &NormaliserStatistics) -> Result<(), Error> {
        Ok(self.policy.set_normaliser(statistics)?)
    }

    /// The learning rate of the networks, and the standard deviation of the actions. The multipliers keep the experiment's
    /// rate.
    fn set_progress(&mut self, used: f64) {
        let Experiment { network, optimiser, .. } = &self.experiment;
        let used = used.clamp(0.0, 1.0);
        let rate = optimiser.learning_rate * (1.0 - (1.0 - optimiser.final_learning_rate_share) * used);
        self.policy.set_scheduled_std(network.initial_std * (network.final_std / network.initial_std).powf(used));
        self.set_learning_rates(rate, optimiser.multiplier_learning_rate);
    }

    fn is_finite(&self) -> bool {
        let networks = self.adam.parameters(self.networks_group).iter().map(Tensor::detach);
        let parameters: Vec<Tensor> = networks.chain([self.multipliers.parameter().detach()]).collect();
        adam::global_norm(&parameters).double_value(&[]).is_finite()
    }

    fn parameter_counts(&self) -> Vec<(String, usize)> {
        let mut parameters = trainable("policy", &self.policy_store);
        parameters.extend(trainable("value", &self.value_store));
        parameters.into_iter().map(|(name, tensor)| (name, tensor.numel())).collect()
    }

    fn remedies(&self) -> &'static str {
        "a lower optimiser.learning_rate or vmpo.epsilon_mean, and an optimiser.max_gradient_norm"
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

/// `[B, T, D]` as rows `[B·T, D]`.
fn rows(tensor: &Tensor) -> Tensor {
    tensor.flatten(0, 1)
}
