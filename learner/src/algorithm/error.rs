//! What can go wrong with a minibatch or a state.

use crate::adam::StateError;
use crate::algorithm::shape::MinibatchShape;
use crate::world;

/// Errors of an algorithm.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A field of a batch has the wrong length.
    #[error("batch field `{field}` has {found} elements where its shape needs {expected}")]
    Length {
        /// The field's name.
        field: &'static str,
        /// Elements needed.
        expected: usize,
        /// Elements found.
        found: usize,
    },
    /// An unroll names a task that does not exist.
    #[error("an unroll is of task {task}, but there are only {tasks} tasks")]
    Task {
        /// As found.
        task: usize,
        /// Number of tasks.
        tasks: usize,
    },
    /// A batch that was made for another task or network.
    #[error("batch is {found:?} with clips below {clips} where the networks take {expected:?} and {known} clips")]
    Shape {
        /// The networks' sizes; unrolls and length are the batch's own.
        expected: Box<MinibatchShape>,
        /// The batch's sizes.
        found: Box<MinibatchShape>,
        /// One more than the largest clip index of the batch.
        clips: usize,
        /// Clips the value function knows.
        known: usize,
    },
    /// The networks refused their parameters or sizes.
    #[error(transparent)]
    Networks(#[from] comic_networks::Error),
    /// The state does not fit.
    #[error(transparent)]
    State(#[from] StateError),
    /// The other ranks are lost.
    #[error(transparent)]
    World(#[from] world::Error),
    /// libtorch refused an operation.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
}

impl From<Error> for crate::error::Error {
    fn from(error: Error) -> Self {
        match error {
            Error::Torch(error) | Error::State(StateError::Torch(error)) => Self::Torch(error),
            Error::Networks(error) => Self::Networks(error),
            Error::World(error) => Self::World(error),
            error => Self::Update(Box::new(error)),
        }
    }
}
