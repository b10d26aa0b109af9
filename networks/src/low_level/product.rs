//! A product of primitives.

use tch::nn;

use super::interface::{Config, Input, LowLevel, Output};
use super::primitives::{Gate, Primitives};
use crate::action::ActionDistribution;
use crate::gaussian::DiagonalGaussian;

/// π(a|s, z) ∝ Π_k N_k(s)^{w_k(z, s)} with w_k in (0, 1), not normalised (S; MCP, Peng et al., 2019). The product is
/// one Gaussian.
///
/// Each exponent is at least 1e-3, because the product would be infinitely wide if all were 0. The σ of the product is
/// at least `min_std`, because a product of many primitives is narrower than each of them (D). The initial exponents
/// are near ½; the initial σ of the primitives is √(K/2)·`initial_std`, so the initial σ of the product is
/// `initial_std` (D).
#[derive(Debug)]
pub(crate) struct ProductLowLevel {
    primitives: Primitives,
    gate: Gate,
    min_std: f64,
}

/// The least exponent (D).
const LEAST_EXPONENT: f64 = 1e-3;

impl ProductLowLevel {
    pub(crate) fn new(path: &nn::Path, config: &Config<'_>) -> Self {
        let wider = (config.network.primitives.count as f64 / 2.0).sqrt();
        let primitives = Primitives::new(path, config, config.network.initial_std * wider);
        Self { primitives, gate: Gate::new(path, config), min_std: config.network.min_std }
    }
}

impl LowLevel for ProductLowLevel {
    fn act(&self, input: &Input<'_>) -> Output {
        let exponents = self.gate.forward(input).sigmoid() * (1.0 - LEAST_EXPONENT) + LEAST_EXPONENT;
        let DiagonalGaussian { mean, std } = self.primitives.forward(input.proprioception).product(&exponents);
        let action = DiagonalGaussian { mean, std: std.clamp_min(self.min_std) };
        Output { action: ActionDistribution::Gaussian(action), state: input.recurrent.state.shallow_clone() }
    }
}
