//! A product of primitives.

use tch::nn;

use super::primitives::{Gate, Primitives};
use super::{Config, Input, LowLevel, Output};
use crate::ActionDistribution;

/// π(a|s, z) ∝ Π_k N_k(s)^{w_k(z, s)}, w_k in (0, 1) and not normalised (S; MCP, Peng et al., 2019): one Gaussian again.
///
/// The exponents start near ½, so the primitives start √(K/2) wider than `initial_std`, and the product as wide (D).
#[derive(Debug)]
pub(crate) struct ProductLowLevel {
    primitives: Primitives,
    gate: Gate,
}

impl ProductLowLevel {
    pub(crate) fn new(path: &nn::Path, config: &Config<'_>) -> Self {
        let wider = (config.network.primitives.count as f64 / 2.0).sqrt();
        let primitives = Primitives::new(path, config, config.network.initial_std * wider);
        Self { primitives, gate: Gate::new(path, config) }
    }
}

impl LowLevel for ProductLowLevel {
    fn act(&self, input: &Input<'_>) -> Output {
        let exponents = self.gate.forward(input).sigmoid();
        let action = self.primitives.forward(input.proprioception).product(&exponents);
        Output { action: ActionDistribution::Gaussian(action), state: input.memory.state.shallow_clone() }
    }
}
