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
    /// A file's description of itself cannot be used.
    #[error("`{field}` of its metadata {problem}")]
    Metadata {
        /// Which part of it.
        field: String,
        /// What is wrong with it, and what helps.
        problem: String,
    },
    /// A file's experiment cannot be used.
    #[error("`experiment` of its metadata: {0}")]
    Experiment(#[source] comic_experiment::Error),
    /// A part of a task that the experiment does not have.
    #[error("no task `{task}` was learnt; its tasks are {known}")]
    NoTask {
        /// The task asked for.
        task: String,
        /// The tasks there are.
        known: String,
    },
    /// TorchScript of what cannot act for itself.
    #[error("TorchScript takes a policy of one task, not `{part}`: export policy:TASK, where TASK is one of {tasks}")]
    Script {
        /// The part asked for.
        part: String,
        /// The tasks there are.
        tasks: String,
    },
    /// A file that is longer than any policy.
    #[error("it has more than {most} bytes: no policy is that long")]
    Long {
        /// Bytes there may be.
        most: u64,
    },
    /// A file that cannot be read or written.
    #[error("{0}")]
    File(#[source] std::io::Error),
    /// libtorch refused an operation.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
}
