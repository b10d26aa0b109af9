//! What can go wrong in the learner. `exit_code.rs` says with which exit code the program then ends.

use std::io::ErrorKind;
use std::path::PathBuf;

/// The learner's errors. A variant does not repeat in its message what its source says; `comic_proto::chain` prints both.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The configuration, the command line or the run's directory is wrong; the message names the remedy.
    #[error("{0}")]
    Configuration(String),
    /// The experiment document cannot be used.
    #[error(transparent)]
    Experiment(#[from] comic_experiment::Error),
    /// The reference clips cannot be used.
    #[error(transparent)]
    Clips(#[from] comic_clips::Error),
    /// An address, a token or a certificate of a client cannot be used.
    #[error(transparent)]
    Access(#[from] comic_proto::AccessError),
    /// Parameters or an exported file do not fit the networks.
    #[error(transparent)]
    Networks(#[from] comic_networks::Error),
    /// The accounting of a checkpoint cannot be restored.
    #[error(transparent)]
    Accounting(#[from] comic_replay::Error),
    /// A batch or a state does not fit the update.
    #[error(transparent)]
    Update(Box<dyn std::error::Error + Send + Sync>),
    /// libtorch refused an operation.
    #[error("libtorch failed")]
    Torch(#[from] tch::TchError),
    /// The ranks of a run cannot go on together.
    #[error(transparent)]
    World(#[from] crate::world::Error),
    /// A device failed, or another process has it.
    #[error("{0}")]
    Device(String),
    /// Losses and gradients stay not finite.
    #[error("{0}")]
    Diverged(String),
    /// A checkpoint, or a part of it, is missing or damaged.
    #[error("{0}")]
    Checkpoint(String),
    /// A JSON document cannot be read or written.
    #[error("{what} is not the JSON that was expected")]
    Json {
        /// The document.
        what: String,
        /// What is wrong with it.
        source: serde_json::Error,
    },
    /// A file or a directory.
    #[error("cannot {action} {}", path.display())]
    File {
        /// What was tried: `read`, `write`, `list`.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
    /// The operating system refused a thread, a socket, a signal handler or the standard output.
    #[error("{what}")]
    System {
        /// What was tried.
        what: String,
        /// Why it failed.
        source: std::io::Error,
    },
    /// The gRPC server ended by itself.
    #[error("the server stopped accepting connections")]
    Server(#[from] tonic::transport::Error),
    /// A certificate cannot be made.
    #[error("cannot make a certificate")]
    Certificate(#[from] rcgen::Error),
    /// A learner that was asked does not answer, or does not serve.
    #[error("{0}")]
    NoAnswer(String),
    /// The process was told twice to stop.
    #[error("stopped by a second signal, without a last checkpoint")]
    Stopped,
    /// A thread of the learner ended by a panic.
    #[error("{0} panicked; the log says where")]
    Panicked(&'static str),
    /// Two parts of the program disagree. This is a defect of the learner.
    #[error("{0}")]
    Defect(String),
    /// Another error, and what the learner did when it occurred.
    #[error("{what}")]
    Within {
        /// What the learner did.
        what: String,
        /// The error.
        source: Box<Error>,
    },
}

impl Error {
    /// Whether the device failed, so that the same start may succeed another time.
    pub fn is_device_failure(&self) -> bool {
        match self {
            Self::Torch(_) | Self::Device(_) | Self::Networks(comic_networks::Error::Torch(_)) => true,
            Self::Within { source, .. } => source.is_device_failure(),
            _ => false,
        }
    }

    /// Whether a disk is full.
    pub fn is_disk_full(&self) -> bool {
        let cause = |error: &(dyn std::error::Error + 'static)| match error.downcast_ref::<std::io::Error>() {
            Some(error) => matches!(error.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded),
            None => false,
        };
        std::iter::successors(Some(self as &(dyn std::error::Error + 'static)), |error| error.source()).any(cause)
    }

    /// A wrong configuration; the message says what is wrong and names the remedy.
    pub fn configuration(message: impl Into<String>) -> Self {
        Self::Configuration(message.into())
    }

    /// Makes an error of `action` on the file at `path`.
    pub(crate) fn file(action: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::File { action, path, source }
    }

    /// Makes an error of something that the operating system refused.
    pub(crate) fn system(what: impl Into<String>) -> impl FnOnce(std::io::Error) -> Self {
        let what = what.into();
        move |source| Self::System { what, source }
    }

    /// Makes an error of a JSON document.
    pub(crate) fn json(what: impl Into<String>) -> impl FnOnce(serde_json::Error) -> Self {
        let what = what.into();
        move |source| Self::Json { what, source }
    }

    /// Says what the learner did when an error occurred.
    pub(crate) fn within<E: Into<Self>>(what: impl Into<String>) -> impl FnOnce(E) -> Self {
        let what = what.into();
        move |source| Self::Within { what, source: Box::new(source.into()) }
    }
}

/// A result with the learner's [`Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_is_recognised_inside_other_errors() {
        let failed = |kind: ErrorKind| {
            Error::within::<Error>("cannot resume")(Error::file("write", "epoch")(kind.into())).is_disk_full()
        };
        assert!(failed(ErrorKind::StorageFull) && !failed(ErrorKind::NotFound));
    }

    #[test]
    fn an_error_keeps_its_exit_code_inside_another() {
        let wrong = || Error::configuration("give another --run");
        let failed = || Error::Checkpoint("no checkpoint".into());
        for (error, code) in [(wrong(), 2), (failed(), 1)] {
            assert_eq!(Error::within("cannot resume")(error).exit_code(), code);
        }
    }
}
