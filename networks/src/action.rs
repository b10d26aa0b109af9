//! The distribution of actions.

use tch::{Kind, Tensor};

use crate::gaussian::DiagonalGaussian;

/// π(a|s) over N rows: one diagonal Gaussian, or a mixture of K of them.
///
/// Actor and learner use only the methods, so they do not depend on the kind of distribution. Densities and divergences
/// are in nats.
#[derive(Debug)]
pub enum ActionDistribution {
    /// One Gaussian over `[N, A]`.
    Gaussian(DiagonalGaussian),
    /// Σ_k w_k N_k, with weights w that add up to 1.
    Mixture {
        /// ln w, `[N, K]`.
        log_weights: Tensor,
        /// The components, over `[N, K, A]`.
        components: DiagonalGaussian,
    },
}

impl ActionDistribution {
    /// From the arrays of an unroll: `mean` and `std` `[N, K·A]`, and `log_weights` `[N, K]`, which is `[N, 0]` for one
    /// component.
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

    /// The arrays of an unroll: mean `[N, K·A]`, standard deviation `[N, K·A]`, and for a mixture ln w `[N, K]`.
    pub fn to_rows(&self) -> (Tensor, Tensor, Option<Tensor>) {
        match self {
            Self::Gaussian(DiagonalGaussian { mean, std }) => (mean.shallow_clone(), std.shallow_clone(), None),
            Self::Mixture { log_weights, components } => {
                let DiagonalGaussian { mean, std } = components;
                (mean.flatten(-2, -1), std.flatten(-2, -1), Some(log_weights.shallow_clone()))
            }
        }
    }

    /// ln π(a), `[N]`, of actions `[N, A]`.
    pub fn log_prob(&self, action: &Tensor) -> Tensor {
        match self {
            Self::Gaussian(gaussian) => gaussian.log_prob(action),
            Self::Mixture { log_weights, components } => {
                (log_weights + components.log_prob(&action.unsqueeze(-2))).logsumexp(-1i64, false)
            }
        }
    }

    /// KL_μ to the behaviour policy, `[N]`. For a mixture: the mean of the components' KL_μ, weighted by the behaviour
    /// policy's weights.
    pub fn kl_mean(&self, behaviour: &Self) -> Tensor {
        self.averaged(behaviour, DiagonalGaussian::kl_mean)
    }

    /// KL_Σ to the behaviour policy, `[N]`. For a mixture: the mean of the components' KL_Σ, weighted by the behaviour
    /// policy's weights.
    pub fn kl_std(&self, behaviour: &Self) -> Tensor {
        self.averaged(behaviour, DiagonalGaussian::kl_std)
    }

    /// KL_discrete = KL(w_old ‖ w), `[N]`; `None` for one component.
    ///
    /// The sum of the three parts is an upper bound of the mixture's KL wherever KL_μ + KL_Σ is an upper bound of each
    /// component's KL. This follows from the chain rule over (component, action), because the mixture is a marginal of
    /// this pair. For a Gaussian the bound holds if it does not become narrower, because KL_μ uses the old standard
    /// deviation. Otherwise V-MPO's limits are an approximation, as for a single Gaussian.
    pub fn kl_weights(&self, behaviour: &Self) -> Option<Tensor> {
        match (self, behaviour) {
            (Self::Mixture { log_weights, .. }, Self::Mixture { log_weights: old, .. }) => {
                Some(sum_last(&(old.exp() * (old - log_weights))))
            }
            _ => None,
        }
    }

    /// The differential entropy, `[N]`. A mixture's entropy has no closed form; for a mixture this is the entropy of
    /// (component, action), which is an upper bound.
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

    /// The action without noise, `[N, A]`: the mean; for a mixture, the mean of the most likely component.
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

    /// The same means with the standard deviation `std`, `[1]`.
    #[must_use]
    pub(crate) fn with_std(self, std: &Tensor) -> Self {
        let spread = |gaussian: DiagonalGaussian| DiagonalGaussian { std: std.expand_as(&gaussian.mean), ..gaussian };
        match self {
            Self::Gaussian(gaussian) => Self::Gaussian(spread(gaussian)),
            Self::Mixture { log_weights, components } => Self::Mixture { log_weights, components: spread(components) },
        }
    }

    /// KL(behaviour ‖ self), `[N]`; `None` for a mixture, which has no closed form.
    pub fn kl_from(&self, behaviour: &Self) -> Option<Tensor> {
        match (self, behaviour) {
            (Self::Gaussian(new), Self::Gaussian(old)) => Some(old.kl(new)),
            _ => None,
        }
    }

    /// The standard deviation, `[N, A]`; for a mixture, the mean of the components' standard deviations with their
    /// weights.
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
            // The learner refuses a minibatch of another kind, so this is not reached; the KL is infinite.
            (Self::Gaussian(DiagonalGaussian { mean, .. }), _) | (_, Self::Gaussian(DiagonalGaussian { mean, .. })) => {
                sum_last(&mean.full_like(f64::INFINITY))
            }
        }
    }
}

/// Σ_k w_k x_k: from `[N, K]` and `[N, K, A]` to `[N, A]`.
fn weighted(log_weights: &Tensor, values: &Tensor) -> Tensor {
    (log_weights.exp().unsqueeze(-1) * values).sum_dim_intlist(-2i64, false, None::<Kind>)
}

fn sum_last(terms: &Tensor) -> Tensor {
    terms.sum_dim_intlist(-1i64, false, None::<Kind>)
}
