//! A mixture of primitives.

use tch::{Kind, nn};

use super::interface::{Config, Input, LowLevel, Output};
use super::primitives::{Gate, Primitives};
use crate::action::ActionDistribution;

/// π(a|s, z) = Σ_k w_k(z, s) N_k(s), Σ w_k = 1 (S; after Wulfmeier et al., 2019).
#[derive(Debug)]
pub(crate) struct MixtureLowLevel {
    primitives: Primitives,
    gate: Gate,
}

impl MixtureLowLevel {
    pub(crate) fn new(path: &nn::Path, config: &Config<'_>) -> Self {
        let primitives = Primitives::new(path, config, config.network.initial_std);
        Self { primitives, gate: Gate::new(path, config) }
    }
}

impl LowLevel for MixtureLowLevel {
    fn act(&self, input: &Input<'_>) -> Output {
        let components = self.primitives.forward(input.proprioception);
        let log_weights = self.gate.forward(input).log_softmax(-1, None::<Kind>);
        let action = ActionDistribution::Mixture { log_weights, components };
        Output { action, state: input.recurrent.state.shallow_clone() }
    }
}
