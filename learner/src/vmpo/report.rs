//! What a step computed, and its report.

use comic_networks::{Acting, ActionDistribution};
use tch::{Kind, Tensor};

use crate::algorithm::loss_report::Losses;
use crate::algorithm::masked_mean::ValidSteps;
use crate::vmpo::improvement::Improvement;
use crate::vmpo::multipliers::Multipliers;
use crate::world::World;

/// One forward pass over a minibatch; N = B·T rows of this rank, M of all ranks.
pub(super) struct Pass {
    pub(super) acting: Acting,
    /// As stored, over N rows.
    pub(super) behaviour: ActionDistribution,
    /// The steps that are learnt from, `[N]` and `[M]`.
    pub(super) valid: ValidSteps,
    /// G − V summed over the reward terms, `[M]`, without gradient.
    pub(super) advantage: Tensor,
    /// G summed over the reward terms, `[M]`.
    pub(super) returns: Tensor,
    /// The E-step that ranks each step, `[M]`; −1 where a step is not learnt from.
    pub(super) group: Tensor,
    /// Fraction of the rows that are transitions.
    pub(super) valid_share: Tensor,
    /// ½ mean (V − G)², summed over the reward terms.
    pub(super) value_loss: Tensor,
    /// Mean KL to the prior, nats a step.
    pub(super) latent_kl: Tensor,
}

/// The result of applying gradients.
pub(super) struct Descent {
    /// Global norm of the networks' gradients before clipping.
    pub(super) norm: Tensor,
    /// Whether the step was taken, a boolean scalar.
    pub(super) finite: Tensor,
}

/// This rank's shares of the numbers of a report. Those of all ranks add up to the whole.
pub(super) fn shares(pass: &Pass, total: &Tensor, improvement: &Improvement, world: &World) -> Tensor {
    let zero = pass.value_loss.zeros_like();
    let std = pass.acting.action.std().mean_dim(-1i64, false, Kind::Float);
    // Every rank has computed the whole of them.
    let [unexplained, variance] =
        [&pass.advantage, &pass.returns].map(|of_all| variance(&pass.valid, of_all) / world.size() as f64);
    let shares: [&Tensor; SHARES] = [
        total,
        &improvement.policy,
        &improvement.temperature,
        &improvement.alpha,
        &pass.value_loss,
        &pass.latent_kl,
        &improvement.kl_mean,
        &improvement.kl_std,
        improvement.kl_weights.as_ref().unwrap_or(&zero),
        &pass.valid.mean(&std),
        &(&pass.valid_share / world.size() as f64),
        &unexplained,
        &variance,
    ];
    Tensor::stack(&shares.map(|share| share.detach().reshape([])), 0)
}

/// Numbers in [`shares`].
const SHARES: usize = 13;

/// The loss that was differentiated, of the sum of all ranks' [`shares`].
pub(super) fn total(sums: &Tensor) -> Tensor {
    sums.select(0, 0)
}

/// The report of a step, from the sum of all ranks' [`shares`], and after which the multipliers are these.
pub(super) fn report(sums: &Tensor, descent: &Descent, multipliers: &Multipliers) -> Losses {
    tch::no_grad(|| {
        let zero = Tensor::zeros([1], (Kind::Float, sums.device()));
        let temperatures = multipliers.temperatures();
        let [alpha_mean, alpha_std] = [multipliers.alpha_mean(), multipliers.alpha_std()];
        let alpha_discrete = multipliers.alpha_discrete();
        let share = |index: i64| sums.select(0, index);
        // The floor keeps the result finite if all returns are equal.
        let explained = 1.0 - share(11) / share(12).clamp_min(1e-12);
        let named = [
            // The loss that was differentiated.
            ("total_loss", &total(sums)),
            // L_π, L_η and L_α.
            ("policy_loss", &share(1)),
            ("temperature_loss", &share(2)),
            ("alpha_loss", &share(3)),
            // ½ (V − G)², mean over valid steps, summed over reward terms.
            ("value_loss", &share(4)),
            // KL of the latent to its prior, nats a step.
            ("latent_kl", &share(5)),
            // Mean KL_μ and KL_Σ to the behaviour policy, and that of a mixture's weights (0 for one Gaussian), nats a
            // step.
            ("kl_mean", &share(6)),
            ("kl_std", &share(7)),
            ("kl_weights", &share(8)),
            // η after the step; the mean if there are several.
            ("temperature", &temperatures.mean(Kind::Float)),
            // α_μ, α_Σ and α_discrete (0 for one Gaussian) after the step.
            ("alpha_mean", &alpha_mean),
            ("alpha_std", &alpha_std),
            ("alpha_discrete", alpha_discrete.as_ref().unwrap_or(&zero)),
            // Mean standard deviation of the policy over valid steps and action dimensions.
            ("policy_std", &share(9)),
            // Global norm of the networks' gradients, before any clipping.
            ("gradient_norm", &descent.norm),
            // 1 − Var(G − V) / Var(G), of the return summed over reward terms.
            ("variance_explained", &explained),
            // Fraction of the rows that are transitions.
            ("valid_share", &share(10)),
        ];
        Losses::pack(named, &temperatures, &descent.finite)
    })
}

/// The variance over the valid steps of all ranks.
fn variance(valid: &ValidSteps, of_all: &Tensor) -> Tensor {
    valid.mean_of_all(&(of_all - valid.mean_of_all(of_all)).square())
}
