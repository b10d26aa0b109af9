//! The recurrent low level.

use tch::{Tensor, nn};

use super::interface::{Config, Input, LowLevel, Output};
use super::size::{Layer, Sizes};
use crate::action::ActionDistribution;
use crate::layers::{GaussianHead, GaussianHeadConfig};
use crate::lstm::LstmStack;

/// `[z, s]` → stacked LSTM layers (S: 384 and 256 units) → mean and σ.
#[derive(Debug)]
pub(crate) struct LstmLowLevel {
    stack: LstmStack,
    head: GaussianHead,
}

impl LstmLowLevel {
    pub(crate) fn new(path: &nn::Path, config: &Config<'_>) -> Self {
        let network = config.network;
        let stack = LstmStack::new(path, config.latent + config.proprioception, &network.lstm.units);
        let head = GaussianHead::new(path, stack.output(), &GaussianHeadConfig::of_actions(config.pose, network));
        Self { stack, head }
    }
}

/// The layers that [`LstmLowLevel::new`] makes.
pub(super) fn layers(sizes: &Sizes<'_>) -> Vec<Layer> {
    let units = &sizes.network.lstm.units;
    let inputs = std::iter::once(sizes.joined()).chain(units.iter().copied());
    let stacked = inputs.clone().zip(units).map(|(input, units)| Layer::Lstm { input, units: *units });
    stacked.chain(inputs.last().map(|width| Layer::dense(width, sizes.head()))).collect()
}

impl LowLevel for LstmLowLevel {
    fn act(&self, input: &Input<'_>) -> Output {
        let joined = Tensor::cat(&[input.intent, input.proprioception], 1);
        // The number of unrolls is not written down: the trace of an exported policy must not contain it.
        let steps = joined.size()[0] / input.recurrent.state.size()[0].max(1);
        let (hidden, state) =
            self.stack.forward(&joined.reshape([-1, steps.max(1), joined.size()[1]]), input.recurrent);
        let hidden = hidden.flatten(0, 1);
        Output { action: ActionDistribution::Gaussian(self.head.forward(&hidden)), state }
    }
}
