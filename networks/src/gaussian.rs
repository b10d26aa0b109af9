//! Gaussians with a diagonal covariance.

use tch::{Kind, Tensor};

/// ½ ln 2π.
const HALF_LN_TAU: f64 = 0.918_938_533_204_672_8;

/// N(mean, diag(std²)) over the last dimension. Leading dimensions are a batch of independent distributions.
///
/// Methods that return a density or a divergence sum over the last dimension: `[.., D]` in, `[..]` out, in nats.
#[derive(Debug)]
pub struct DiagonalGaussian {
    /// μ, `[.., D]`.
    pub mean: Tensor,
    /// σ, the standard deviation, `[.., D]`, positive.
    pub std: Tensor,
}

impl DiagonalGaussian {
    /// A sample μ + σ·noise, with standard-normal `noise` of the same shape. Gradients flow to μ and σ.
    pub fn sample(&self, noise: &Tensor) -> Tensor {
        self.mean.addcmul(&self.std, noise)
    }

    /// ln p(value).
    pub fn log_prob(&self, value: &Tensor) -> Tensor {
        let deviation = (value - &self.mean) / &self.std;
        let terms = deviation.square() * -0.5 - self.std.log() - HALF_LN_TAU;
        sum_last(&terms)
    }

    /// The differential entropy.
    pub fn entropy(&self) -> Tensor {
        sum_last(&(self.std.log() + (HALF_LN_TAU + 0.5)))
    }

    /// KL(self ‖ other).
    pub fn kl(&self, other: &Self) -> Tensor {
        let ratio = &self.std / &other.std;
        let deviation = (&self.mean - &other.mean) / &other.std;
        let terms = (ratio.square() + deviation.square() - 1.0) * 0.5 - ratio.log();
        sum_last(&terms)
    }

    /// KL_μ, the part of KL(behaviour ‖ self) due to the mean, with the covariance of the behaviour policy:
    /// ½ Σ ((μ − μ_old) / σ_old)². Exactly 0 if the means are equal.
    pub fn kl_mean(&self, behaviour: &Self) -> Tensor {
        let deviation = (&self.mean - &behaviour.mean) / &behaviour.std;
        sum_last(&deviation.square()) * 0.5
    }

    /// KL_Σ, the part of KL(behaviour ‖ self) due to the covariance, with equal means:
    /// Σ [ln(σ / σ_old) + ½ (σ_old² / σ² − 1)]. Exactly 0 if the standard deviations are equal.
    pub fn kl_std(&self, behaviour: &Self) -> Tensor {
        let ratio = &behaviour.std / &self.std;
        let terms = (ratio.square() - 1.0) * 0.5 - ratio.log();
        sum_last(&terms)
    }

    /// The normalised product Π_k N_k^{w_k} of K Gaussians `[.., K, D]` with positive exponents `[.., K]`: a Gaussian
    /// `[.., D]`. Its precision is Σ w_k / σ_k², and its mean is the mean of the μ_k weighted by the precisions.
    pub fn product(&self, exponents: &Tensor) -> Self {
        let sum = |terms: &Tensor| terms.sum_dim_intlist(-2i64, false, None::<Kind>);
        let precisions = exponents.unsqueeze(-1) / self.std.square();
        let variance = sum(&precisions).reciprocal();
        Self { mean: sum(&(&precisions * &self.mean)) * &variance, std: variance.sqrt() }
    }

    /// KL(self ‖ N(0, I)).
    pub fn kl_to_standard_normal(&self) -> Tensor {
        let terms = (self.mean.square() + self.std.square() - 1.0) * 0.5 - self.std.log();
        sum_last(&terms)
    }

    /// KL(self ‖ p(z_t | z_{t−1})) for the prior p = N(α z_{t−1}, (1 − α²) I). With this variance N(0, I) is stationary.
    ///
    /// `previous` is z_{t−1}, `[.., D]`. `first` is `[..]` and 1 at the first step of an episode, where the prior is N(0, I).
    pub fn kl_to_ar1(&self, alpha: f64, previous: &Tensor, first: &Tensor) -> Tensor {
        let first = first.unsqueeze(-1);
        let other = Self {
            mean: previous * ((1.0 - &first) * alpha),
            // √(1 − α²) inside an episode, 1 at its first step.
            std: (&first * (alpha * alpha) + (1.0 - alpha * alpha)).sqrt(),
        };
        self.kl(&other)
    }
}

fn sum_last(terms: &Tensor) -> Tensor {
    terms.sum_dim_intlist(-1i64, false, None::<Kind>)
}
