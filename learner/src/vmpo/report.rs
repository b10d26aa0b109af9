//! What a step computed, and its report.

use comic_networks::{Acting, ActionDistribution};
use tch::{Kind, Tensor};

use crate::algorithm::loss_report::Losses;
use crate::algorithm::masked_mean::masked_mean;
use crate::vmpo::improvement::Improvement;
use crate::vmpo::multipliers::Multipliers;

/// One forward pass over a minibatch; N = B·T rows.
pub(super) struct Pass {
    pub(super) acting: Acting,
    /// As stored, over N rows.
    pub(super) behaviour: ActionDistribution,
    /// V(s_t), `[N, R]`, with gradient.
    pub(super) values: Tensor,
    /// G_t, `[N, R]`.
    pub(super) targets: Tensor,
    /// 1 for the steps that are learnt from, `[N]`.
    pub(super) valid: Tensor,
    /// The steps that each E-step ranks, `[N]` booleans; together all of them.
    pub(super) groups: Vec<Tensor>,
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

/// The report of a step that differentiated `total`, and after which the multipliers are these.
pub(super) fn report(
    pass: &Pass,
    descent: &Descent,
    total: &Tensor,
    improvement: &Improvement,
    multipliers: &Multipliers,
) -> Losses {
    tch::no_grad(|| {
        let zero = Tensor::zeros([1], (Kind::Float, pass.valid.device()));
        let temperatures = multipliers.temperatures();
        let [alpha_mean, alpha_std] = [multipliers.alpha_mean(), multipliers.alpha_std()];
        let alpha_discrete = multipliers.alpha_discrete();
        let std = pass.acting.action.std().mean_dim(-1i64, false, Kind::Float);
        let named = [
            // The loss that was differentiated.
            ("total_loss", total),
            // L_π, L_η and L_α.
            ("policy_loss", &improvement.policy),
            ("temperature_loss", &improvement.temperature),
            ("alpha_loss", &improvement.alpha),
            // ½ (V − G)², mean over valid steps, summed over reward terms.
            ("value_loss", &pass.value_loss),
            // KL of the latent to its prior, nats a step.
            ("latent_kl", &pass.latent_kl),
            // Mean KL_μ and KL_Σ to the behaviour policy, and that of a mixture's weights (0 for one Gaussian), nats a
            // step.
            ("kl_mean", &improvement.kl_mean),
            ("kl_std", &improvement.kl_std),
            ("kl_weights", improvement.kl_weights.as_ref().unwrap_or(&zero)),
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
            // Fraction of the rows that are transitions.
            ("valid_share", &pass.valid_share),
        ];
        Losses::pack(named, &temperatures, &descent.finite)
    })
}

/// 1 − Var(G − V) / Var(G) over the valid steps, of the return summed over its terms.
fn variance_explained(pass: &Pass) -> Tensor {
    let variance = |terms: &Tensor| {
        let total = terms.sum_dim_intlist(-1i64, false, Kind::Float);
        let mean = masked_mean(&total, &pass.valid);
        masked_mean(&(total - mean).square(), &pass.valid)
    };
    let unexplained = variance(&(&pass.targets - &pass.values));
    // The floor keeps the result finite if all returns are equal.
    1.0 - unexplained / variance(&pass.targets).clamp_min(1e-12)
}
