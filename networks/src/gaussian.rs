//! Gaussians with a diagonal covariance.

use comic_experiment::Prior;
use tch::{Kind, Tensor};

/// ½ ln 2π.
const HALF_LN_TAU: f64 = 0.918_938_533_204_672_8;

/// N(mean, diag(std²)) over the last dimension; any leading dimensions are a batch of independent distributions.
///
/// Every method that returns a density or a divergence sums over the last dimension: `[.., D]` in, `[..]` out, in nats.
#[derive(Debug)]
pub struct DiagonalGaussian {
    /// μ, `[.., D]`.
    pub mean: Tensor,
    /// σ, the standard deviation (never the variance, never its logarithm), `[.., D]`, positive.
    pub std: Tensor,
}

impl DiagonalGaussian {
    /// μ + σ·noise, with standard-normal `noise` of the same shape: a sample that carries the gradient of μ and σ.
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

    /// KL_μ, the part of KL(behaviour ‖ self) that is the mean's, with the behaviour's covariance kept:
    /// ½ Σ ((μ − μ_old) / σ_old)². Exactly 0 where the means are equal.
    pub fn kl_mean(&self, behaviour: &Self) -> Tensor {
        let deviation = (&self.mean - &behaviour.mean) / &behaviour.std;
        sum_last(&deviation.square()) * 0.5
    }

    /// KL_Σ, the part of KL(behaviour ‖ self) that is the covariance's, with the mean kept:
    /// Σ [ln(σ / σ_old) + ½ (σ_old² / σ² − 1)]. Exactly 0 where the standard deviations are equal.
    pub fn kl_std(&self, behaviour: &Self) -> Tensor {
        let ratio = &behaviour.std / &self.std;
        let terms = (ratio.square() - 1.0) * 0.5 - ratio.log();
        sum_last(&terms)
    }

    /// Π_k N_k^{w_k}, normalised: of K Gaussians over `[.., K, D]` and positive exponents `[.., K]` one over `[.., D]`, with
    /// precision Σ w_k / σ_k² and the mean that the precisions weigh.
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

    /// KL(self ‖ p(z_t | z_{t−1})), where p is the `prior`.
    ///
    /// `previous` is z_{t−1}, `[.., D]`; `first` is `[..]`, 1 at an episode's first step, where every prior is N(0, I).
    /// The AR(1) prior is N(α z_{t−1}, (1 − α²) I): its variance is 1 − α², so that N(0, I) is stationary.
    pub fn kl_to_prior(&self, prior: &Prior, previous: &Tensor, first: &Tensor) -> Tensor {
        match *prior {
            Prior::Standard => self.kl_to_standard_normal(),
            Prior::Ar1 { alpha } => {
                let first = first.unsqueeze(-1);
                let other = Self {
                    mean: previous * ((1.0 - &first) * alpha),
                    // √(1 − α²) inside an episode, 1 at its first step.
                    std: (&first * (alpha * alpha) + (1.0 - alpha * alpha)).sqrt(),
                };
                self.kl(&other)
            }
        }
    }
}

fn sum_last(terms: &Tensor) -> Tensor {
    terms.sum_dim_intlist(-1i64, false, None::<Kind>)
}
