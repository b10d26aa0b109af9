//! The sizes of a low level's layers.

use comic_experiment::Network;

/// Sizes that determine the layers of a low level.
#[derive(Clone, Copy, Debug)]
pub struct Sizes<'a> {
    /// P, the size of proprioception.
    pub proprioception: usize,
    /// A, the size of an action.
    pub actions: usize,
    /// The section `network` of the experiment.
    pub network: &'a Network,
}

impl Sizes<'_> {
    /// Z + P, the width of latent and proprioception together.
    pub(super) fn joined(&self) -> usize {
        self.network.latent.size + self.proprioception
    }

    /// Width of a head: mean and standard deviation of each action.
    pub(super) fn head(&self) -> usize {
        2 * self.actions
    }
}

/// A layer of a low level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layer {
    /// A dense layer.
    Dense {
        /// Width of the input.
        input: usize,
        /// Width of the output.
        output: usize,
        /// Whether the gradient flows to the input.
        flows_on: bool,
    },
    /// An LSTM layer.
    Lstm {
        /// Width of the input.
        input: usize,
        /// Width of the output, of the hidden state and of the cell state.
        units: usize,
    },
}

impl Layer {
    /// A dense layer.
    pub(super) fn dense(input: usize, output: usize) -> Self {
        Self::Dense { input, output, flows_on: true }
    }

    /// Dense layers on top of one another.
    pub(super) fn stack(input: usize, outputs: &[usize]) -> Vec<Self> {
        let inputs = std::iter::once(&input).chain(outputs);
        inputs.zip(outputs).map(|(input, output)| Self::dense(*input, *output)).collect()
    }

    /// Number of entries of its matrices.
    pub fn weights(self) -> u64 {
        match self {
            Self::Dense { input, output, .. } => input as u64 * output as u64,
            Self::Lstm { input, units } => 4 * units as u64 * (input as u64 + units as u64),
        }
    }
}
