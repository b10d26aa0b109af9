//! The distribution of actions.

use tch::{Kind, Tensor};

use crate::gaussian::DiagonalGaussian;

/// π(a|s) over N rows: one diagonal Gaussian, or a mixture of K of them.
///
/// Whoever acts or learns need not know which: every density, divergence and mean is asked for here.
#[derive(Debug)]
pub enum ActionDistribution {
    /// One Gaussian over `[N, A]`.
    Gaussian(DiagonalGaussian),
    /// Σ_k w_k N_k.
    Mixture {
        /// ln w, `[N, K]`; the weights add up to 1.
        log_weights: Tensor,
        /// The components, over `[N, K, A]`.
        components: DiagonalGaussian,
    },
}

impl ActionDistribution {
    /// From the arrays that travel: `mean` and `std` `[N, K·A]`, `log_weights` `[N, K]`, which is `[N, 0]` where there is
    /// one component.
    pub fn from_rows(mean: &Tensor, std: &Tensor, log_weights: &Tensor) -> Self {
        let (mean, std) = (mean.shallow_clone(), std.shallow_clone());
        match log_weights.size().last().copied().unwrap_or(0) {
            0 => Self::Gaussian(DiagonalGaussian { mean, std }),
            count => {
                let split = |tensor: Tensor| tensor.unflatten(-1, [count, -1]);
                let components = DiagonalGaussian { mean: split(mean), std: split(std) };
                Self::Mixture { log_weights: log_weights.shallow_clone(), components }
            }
        }
    }

    /// The arrays that travel: mean `[N, K·A]`, standard deviation `[N, K·A]`, and, of a mixture, ln w `[N, K]`.
    pub fn to_rows(&self) -> (Tensor, Tensor, Option<Tensor>) {
        match self {
            Self::Gaussian(DiagonalGaussian { mean, std }) => (mean.shallow_clone(), std.shallow_clone(), None),
            Self::Mixture { log_weights, components } => {
                let DiagonalGaussian { mean, std } = components;
                (mean.flatten(-2, -1), std.flatten(-2, -1), Some(log_weights.shallow_clone()))
            }
        }
    }

    /// ln π(a), `[N]`, of actions `[N, A]`. Of a mixture, by log-sum-exp.
    pub fn log_prob(&self, action: &Tensor) -> Tensor {
        match self {
            Self::Gaussian(gaussian) => gaussian.log_prob(action),
            Self::Mixture { log_weights, components } => {
                (log_weights + components.log_prob(&action.unsqueeze(-2))).logsumexp(-1i64, false)
            }
        }
    }

    /// KL_μ to the behaviour policy, `[N]`: of a mixture, each component's, averaged with the behaviour's weights.
    pub fn kl_mean(&self, behaviour: &Self) -> Tensor {
        self.averaged(behaviour, DiagonalGaussian::kl_mean)
    }

    /// KL_Σ to the behaviour policy, `[N]`: of a mixture, each component's, averaged with the behaviour's weights.
    pub fn kl_std(&self, behaviour: &Self) -> Tensor {
        self.averaged(behaviour, DiagonalGaussian::kl_std)
    }

    /// KL_discrete = KL(w_old ‖ w), `[N]`; none where there is one component.
    ///
    /// The three parts bound the mixture's own KL from above as they bound each component's, by the chain rule over
    /// (component, action), of which the mixture is a marginal. They bound a Gaussian's where it grows no narrower, since
    /// KL_μ is measured in the old deviation; beyond that V-MPO's limits are an approximation, as for one Gaussian.
    pub fn kl_weights(&self, behaviour: &Self) -> Option<Tensor> {
        match (self, behaviour) {
            (Self::Mixture { log_weights, .. }, Self::Mixture { log_weights: old, .. }) => {
                Some(sum_last(&(old.exp() * (old - log_weights))))
            }
            _ => None,
        }
    }

    /// Σ ½ ((μ − target) / scale)², `[N]`, of targets `[N, A]`: of a mixture each component's, averaged with the weights, so
    /// that whichever acts aims there.
    pub fn mean_error(&self, target: &Tensor, scale: f64) -> Tensor {
        let error = |mean: &Tensor, target: &Tensor| sum_last(&((mean - target) / scale).square()) * 0.5;
        match self {
            Self::Gaussian(gaussian) => error(&gaussian.mean, target),
            Self::Mixture { log_weights, components } => {
                sum_last(&(log_weights.exp() * error(&components.mean, &target.unsqueeze(-2))))
            }
        }
    }

    /// The differential entropy, `[N]`. A mixture has none in closed form: what is given bounds it from above, the
    /// entropy of (component, action).
    pub fn entropy(&self) -> Tensor {
        match self {
            Self::Gaussian(gaussian) => gaussian.entropy(),
            Self::Mixture { log_weights, components } => {
                sum_last(&(log_weights.exp() * (components.entropy() - log_weights)))
            }
        }
    }

    /// E\[a\], `[N, A]`.
    pub fn mean(&self) -> Tensor {
        match self {
            Self::Gaussian(gaussian) => gaussian.mean.shallow_clone(),
            Self::Mixture { log_weights, components } => weighted(log_weights, &components.mean),
        }
    }

    /// The action without noise, `[N, A]`: the mean; of a mixture, that of the likeliest component.
    pub fn mode(&self) -> Tensor {
        match self {
            Self::Gaussian(gaussian) => gaussian.mean.shallow_clone(),
            Self::Mixture { log_weights, components } => {
                let actions = components.mean.size()[2];
                let likeliest = log_weights.argmax(-1, true).unsqueeze(-1).expand([-1, -1, actions], false);
                components.mean.gather(1, &likeliest, false).squeeze_dim(1)
            }
        }
    }

    /// The standard deviation, `[N, A]`; of a mixture, the components' own, averaged with their weights.
    pub fn std(&self) -> Tensor {
        match self {
            Self::Gaussian(gaussian) => gaussian.std.shallow_clone(),
            Self::Mixture { log_weights, components } => weighted(log_weights, &components.std),
        }
    }

    fn averaged(&self, behaviour: &Self, kl: fn(&DiagonalGaussian, &DiagonalGaussian) -> Tensor) -> Tensor {
        match (self, behaviour) {
            (Self::Gaussian(new), Self::Gaussian(old)) => kl(new, old),
            (Self::Mixture { components: new, .. }, Self::Mixture { log_weights, components: old }) => {
                sum_last(&(log_weights.exp() * kl(new, old)))
            }
            // The learner refuses a minibatch of another kind; beyond that, two kinds have no limit in common.
            (Self::Gaussian(DiagonalGaussian { mean, .. }), _) | (_, Self::Gaussian(DiagonalGaussian { mean, .. })) => {
                sum_last(&mean.full_like(f64::INFINITY))
            }
        }
    }
}

/// Σ_k w_k x_k: `[N, K]` and `[N, K, A]` to `[N, A]`.
fn weighted(log_weights: &Tensor, values: &Tensor) -> Tensor {
    (log_weights.exp().unsqueeze(-1) * values).sum_dim_intlist(-2i64, false, None::<Kind>)
}

fn sum_last(terms: &Tensor) -> Tensor {
    terms.sum_dim_intlist(-1i64, false, None::<Kind>)
}
