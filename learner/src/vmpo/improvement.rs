//! The policy improvement losses.

use comic_experiment::Vmpo;
use tch::{Kind, Tensor};

use crate::algorithm::masked_mean::ValidSteps;
use crate::vmpo::multipliers::Multipliers;
use crate::world::World;

/// The inputs of the losses: one number a step. Those of all ranks are in the order of the ranks; the others have the same shape.
#[derive(Debug)]
pub struct Evidence<'a> {
    /// ln π(a|s), of the unclipped action, under the current parameters.
    pub log_prob: &'a Tensor,
    /// A of the steps of all ranks; no gradient flows back into it.
    pub advantage: &'a Tensor,
    /// KL_μ to the behaviour policy, summed over dimensions.
    pub kl_mean: &'a Tensor,
    /// KL_Σ to the behaviour policy, summed over dimensions.
    pub kl_std: &'a Tensor,
    /// KL of a mixture's weights to the behaviour policy's.
    pub kl_weights: Option<&'a Tensor>,
    /// The whole KL(behaviour ‖ π), if there is a control variate.
    pub kl: Option<&'a Tensor>,
    /// The steps that are transitions; another step has no influence, whatever its numbers are.
    pub valid: &'a ValidSteps,
    /// Which steps of all ranks each E-step ranks, booleans: one group for each η, and no step is in two groups.
    pub groups: &'a [Tensor],
    /// The ranks whose steps all this is about.
    pub world: &'a World,
}

/// V-MPO's limits on the KLs, and the fraction of the steps that it ranks highest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KlLimits {
    /// ε_η.
    pub epsilon_eta: f64,
    /// ε_μ.
    pub epsilon_mean: f64,
    /// ε_Σ.
    pub epsilon_std: f64,
    /// ε_discrete.
    pub epsilon_discrete: f64,
    /// Fraction of the valid steps in D̃.
    pub top_fraction: f64,
    /// κ: weight of the control variate.
    pub control_variate: f64,
}

impl From<&Vmpo> for KlLimits {
    fn from(config: &Vmpo) -> Self {
        Self {
            epsilon_eta: config.epsilon_eta,
            epsilon_mean: config.epsilon_mean,
            epsilon_std: config.epsilon_std,
            epsilon_discrete: config.epsilon_discrete,
            top_fraction: config.top_fraction,
            control_variate: config.control_variate,
        }
    }
}

/// The losses, scalars that carry gradient, and the mean KLs they were made from: this rank's share of each. Those of all ranks add up
/// to the whole, and so do their gradients.
#[derive(Debug)]
pub struct Improvement {
    /// L_π.
    pub policy: Tensor,
    /// L_η.
    pub temperature: Tensor,
    /// L_α, every constraint: the multipliers' own loss and the penalty on the policy.
    pub alpha: Tensor,
    /// Mean KL_μ over the valid steps, without gradient.
    pub kl_mean: Tensor,
    /// Mean KL_Σ over the valid steps, without gradient.
    pub kl_std: Tensor,
    /// Mean KL of a mixture's weights over the valid steps, without gradient.
    pub kl_weights: Option<Tensor>,
}

impl Improvement {
    /// L_π + L_η + L_α.
    pub fn total(&self) -> Tensor {
        &self.policy + &self.temperature + &self.alpha
    }
}

/// L_π, L_η and L_α.
///
/// - D̃ holds the ⌊`top_fraction` · valid steps⌋ (at least one) largest advantages of the valid steps, and steps that tie
///   with the smallest of them, so that the order of the batch does not matter.
/// - L_π = −Σ_{D̃} ψ ln π(a|s), ψ = softmax over D̃ of A/η, without gradient.
///   With the control variate, L_π has the term κ · mean over valid steps of ln π(a|s) + KL(behaviour ‖ π). Its expected
///   gradient is 0 for a policy that does not depend on the sampled actions, which is exact in the first gradient step on a
///   batch, because E_behaviour[ln π] = −KL − (the behaviour's entropy). Without it, imitating the best half of the actions
///   also imitates noise that has nothing to do with their advantages.
/// - L_η = η ε_η + η ln(1/|D̃| Σ_{D̃} exp(A/η)).
/// - L_α = Σ_k α_k (ε_k − sg KL_k) + sg(α_k) KL_k, KL_k the mean over all valid steps.
///
/// Each group has its own D̃ and η. L_π and L_η are the means over the groups, weighted by each group's fraction of the
/// valid steps (D). So a step counts the same whatever its group, and a group without a step has no influence.
pub fn policy_improvement(evidence: &Evidence, multipliers: &Multipliers, limits: &KlLimits) -> Improvement {
    let valid = evidence.valid;
    let (mut policy, temperature) = expectation_steps(evidence, multipliers, limits);
    if let Some(kl) = evidence.kl {
        policy = &policy + valid.mean(&(evidence.log_prob + kl)) * limits.control_variate;
    }
    // The share of a limit that the whole mean is held to.
    let constraint = |kl: &Tensor, alpha: &Tensor, epsilon: f64| {
        alpha * (epsilon / evidence.world.size() as f64 - kl.detach()) + alpha.detach() * kl
    };
    let kl_mean = valid.mean(evidence.kl_mean);
    let kl_std = valid.mean(evidence.kl_std);
    let gaussian = constraint(&kl_mean, &multipliers.alpha_mean(), limits.epsilon_mean)
        + constraint(&kl_std, &multipliers.alpha_std(), limits.epsilon_std);
    let kl_weights = evidence.kl_weights.map(|kl| valid.mean(kl));
    let alpha = match (&kl_weights, multipliers.alpha_discrete()) {
        (Some(kl), Some(multiplier)) => gaussian + constraint(kl, &multiplier, limits.epsilon_discrete),
        _ => gaussian,
    };
    Improvement {
        policy,
        temperature,
        alpha,
        kl_mean: kl_mean.detach(),
        kl_std: kl_std.detach(),
        kl_weights: kl_weights.map(|kl| kl.detach()),
    }
}

fn expectation_steps(evidence: &Evidence, multipliers: &Multipliers, limits: &KlLimits) -> (Tensor, Tensor) {
    let (world, valid) = (evidence.world, evidence.valid);
    let advantage = evidence.advantage.detach();
    let (mut policies, mut temperatures) = (Vec::new(), Vec::new());
    for (group, eta) in evidence.groups.iter().zip(multipliers.temperatures().unbind(0)) {
        let mask = valid.all().logical_and(group);
        let fraction = mask.sum(Kind::Float) / valid.count();
        let step = expectation_step(&advantage, &mask, &eta, limits);
        let [weights, selected] = [&step.weights, &step.selected].map(|all| world.own_part(all));
        let log_prob = evidence.log_prob.where_scalarother(&selected, 0.0);
        policies.push(-(weights * log_prob).sum(Kind::Float) * &fraction);
        // Every rank has computed the whole of it.
        temperatures.push(step.temperature * fraction / world.size() as f64);
    }
    let sum = |terms: &[Tensor]| Tensor::stack(terms, 0).sum(Kind::Float);
    (sum(&policies), sum(&temperatures))
}

/// The E-step of one group, over the steps of all ranks.
struct ExpectationStep {
    /// D̃, booleans.
    selected: Tensor,
    /// ψ.
    weights: Tensor,
    /// L_η.
    temperature: Tensor,
}

fn expectation_step(advantage: &Tensor, mask: &Tensor, eta: &Tensor, limits: &KlLimits) -> ExpectationStep {
    let selected = top(advantage, mask, limits.top_fraction);
    // A step that is not valid may have NaN, and in the gradient of η 0 · NaN is NaN.
    let scaled = advantage.where_scalarother(mask, 0.0) / eta;
    // The log-sum-exp subtracts the maximum. If no step is valid, the maximum is set to 0. Otherwise it would be −∞ on a CPU,
    // which gives NaN, and the smallest finite number on XLA, which overflows below.
    let maximum = scaled.detach().where_scalarother(&selected, f64::NEG_INFINITY).max();
    let maximum = maximum.where_scalarother(&selected.any(), 0.0);
    let exponentials = (&scaled - &maximum).where_scalarother(&selected, f64::NEG_INFINITY).exp();
    // The largest term is exp(0), so the floor binds only where no step is valid.
    let sum = exponentials.sum(Kind::Float).clamp_min(1.0);
    let count = selected.sum(Kind::Float).clamp_min(1.0);
    let temperature = eta * (sum.log() + &maximum - count.log() + limits.epsilon_eta);
    let weights = (&exponentials / &sum).detach();
    ExpectationStep { selected, weights, temperature }
}

/// The mask of D̃, by a threshold: no shape depends on how many steps are valid.
fn top(advantage: &Tensor, mask: &Tensor, fraction: f64) -> Tensor {
    let candidates = advantage.where_scalarother(mask, f64::NEG_INFINITY).flatten(0, -1);
    let (sorted, _) = candidates.sort(0, true);
    // A scalar in double precision, so that ⌊fraction · n⌋ is what the same product gives elsewhere.
    let rank = (mask.sum(Kind::Double) * fraction).floor().clamp_min(1.0).to_kind(Kind::Int64) - 1;
    let threshold = sorted.index_select(0, &rank.reshape([1]));
    advantage.ge_tensor(&threshold).logical_and(mask)
}
