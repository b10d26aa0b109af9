//! The sizes of a low level's layers.

use comic_experiment::Network;

/// Sizes that a low level's layers follow from.
#[derive(Clone, Copy, Debug)]
pub struct Sizes<'a> {
    /// P.
    pub proprioception: usize,
    /// A.
    pub actions: usize,
    /// The experiment's section.
    pub network: &'a Network,
}

impl Sizes<'_> {
    /// Z + P.
    pub(super) fn joined(&self) -> usize {
        self.network.latent.size + self.proprioception
    }

    /// A mean and a deviation for each action.
    pub(super) fn head(&self) -> usize {
        2 * self.actions
    }
}

/// What a low level multiplies every row by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layer {
    /// A matrix.
    Dense {
        /// Numbers in.
        input: usize,
        /// Numbers out.
        output: usize,
        /// Whether the gradient flows on to what came in.
        flows_on: bool,
    },
    /// An LSTM layer.
    Lstm {
        /// Numbers in.
        input: usize,
        /// Numbers out, and in either state.
        units: usize,
    },
}

impl Layer {
    /// One matrix.
    pub(super) fn dense(input: usize, output: usize) -> Self {
        Self::Dense { input, output, flows_on: true }
    }

    /// Matrices on top of one another.
    pub(super) fn stack(input: usize, outputs: &[usize]) -> Vec<Self> {
        let inputs = std::iter::once(&input).chain(outputs);
        inputs.zip(outputs).map(|(input, output)| Self::dense(*input, *output)).collect()
    }

    /// Entries of its matrices.
    pub fn weights(self) -> u64 {
        match self {
            Self::Dense { input, output, .. } => input as u64 * output as u64,
            Self::Lstm { input, units } => 4 * units as u64 * (input as u64 + units as u64),
        }
    }
}
