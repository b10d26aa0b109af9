//! The errors of parameters and files that come from outside.

/// Errors of this crate.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The bytes are not a safetensors document.
    #[error("parameters are not a valid safetensors document: {0}")]
    Malformed(#[from] safetensors::SafeTensorError),
    /// The document does not have a parameter of the network.
    #[error("parameter `{name}` is missing; both sides must use the same experiment and version")]
    Missing {
        /// The parameter's name.
        name: String,
    },
    /// The network does not have a parameter of the document.
    #[error("parameter `{name}` is unknown to this network; both sides must use the same experiment and version")]
    Unknown {
        /// The parameter's name.
        name: String,
    },
    /// A parameter has another shape than the network's.
    #[error("parameter `{name}` has shape {found:?}, but the network has {expected:?}")]
    Shape {
        /// The parameter's name.
        name: String,
        /// The network's shape.
        expected: Vec<i64>,
        /// The document's shape.
        found: Vec<i64>,
    },
    /// The element type of a parameter is not F32.
    #[error("parameter `{name}` has elements of type {found}; only F32 is accepted")]
    Kind {
        /// The parameter's name.
        name: String,
        /// The document's element type.
        found: String,
    },
    /// A parameter has an infinity or a NaN, or a standard deviation that is not positive.
    #[error("`{name}` has {what}; the parameters are refused")]
    Number {
        /// The parameter's name.
        name: String,
        /// What is wrong with it.
        what: &'static str,
    },
    /// The length of a vector does not fit the task.
    #[error("`{name}` has {found} entries, but the task has {expected}")]
    Length {
        /// Name of the vector.
        name: &'static str,
        /// Number of entries of the task.
        expected: usize,
        /// Number of entries given.
        found: usize,
    },
    /// The metadata of a file cannot be used.
    #[error("`{field}` of its metadata {problem}")]
    Metadata {
        /// The field of the metadata.
        field: String,
        /// What is wrong, and what to do.
        problem: String,
    },
    /// The experiment in a file's metadata cannot be used.
    #[error("`experiment` of its metadata: {0}")]
    Experiment(#[source] comic_experiment::Error),
    /// The experiment does not have the task of a part.
    #[error("task `{task}` was not learnt; the learnt tasks are {known}")]
    NoTask {
        /// The requested task.
        task: String,
        /// The tasks of the experiment.
        known: String,
    },
    /// The part cannot be exported from a transfer, whose policy has no encoder and no low level of its own.
    #[error(
        "`{part}` is not part of a transfer's policy, which gives latents to a frozen low level: export policy or \
         policy:TASK"
    )]
    Transfer {
        /// The requested part.
        part: String,
    },
    /// The file holds no low level that can be used frozen.
    #[error("no low level for a transfer: {problem}")]
    NotLowLevel {
        /// What is wrong, and what to do.
        problem: String,
    },
    /// The part cannot be exported as TorchScript or ONNX, because it is not a policy of one task.
    #[error(
        "only a policy of one task can be exported as TorchScript or ONNX, not `{part}`: export policy:TASK; tasks are \
         {tasks}"
    )]
    Script {
        /// The requested part.
        part: String,
        /// The tasks of the experiment.
        tasks: String,
    },
    /// The policy has an operator that cannot be written as ONNX.
    #[error("the policy cannot be written as ONNX: {problem}; export it as TorchScript, to a file .pt")]
    Onnx {
        /// What cannot be written.
        problem: String,
    },
    /// The file is longer than any policy.
    #[error("the file has more than {most} bytes, which is more than a policy can have")]
    Long {
        /// Greatest allowed length, bytes.
        most: u64,
    },
    /// The file cannot be read or written.
    #[error("{0}")]
    File(#[source] std::io::Error),
    /// An operation of libtorch failed.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
}
