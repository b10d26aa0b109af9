//! What can go wrong with parameters that come from outside.

/// Errors of this crate.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The bytes are no safetensors document.
    #[error("parameters are not a valid safetensors document: {0}")]
    Malformed(#[from] safetensors::SafeTensorError),
    /// A parameter that the network has is absent.
    #[error("parameter `{name}` is missing; both sides must use the same experiment and version")]
    Missing {
        /// The parameter's name.
        name: String,
    },
    /// A parameter that the network does not have.
    #[error("parameter `{name}` is unknown to this network; both sides must use the same experiment and version")]
    Unknown {
        /// The parameter's name.
        name: String,
    },
    /// A parameter of another shape.
    #[error("parameter `{name}` has shape {found:?} where the network has {expected:?}")]
    Shape {
        /// The parameter's name.
        name: String,
        /// The network's shape.
        expected: Vec<i64>,
        /// The document's shape.
        found: Vec<i64>,
    },
    /// A parameter of another element type.
    #[error("parameter `{name}` has elements of type {found}; only F32 is accepted")]
    Kind {
        /// The parameter's name.
        name: String,
        /// The document's element type.
        found: String,
    },
    /// A parameter that holds an infinity or a NaN, or a standard deviation that is not positive.
    #[error("`{name}` holds {what}; these parameters are not taken")]
    Number {
        /// The parameter's name.
        name: String,
        /// What is wrong with it.
        what: &'static str,
    },
    /// A vector whose length does not fit the task.
    #[error("`{name}` has {found} entries where the task has {expected}")]
    Length {
        /// What the vector is.
        name: &'static str,
        /// Entries needed.
        expected: usize,
        /// Entries given.
        found: usize,
    },
    /// libtorch refused an operation.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
}
