//! The errors of an actor.

use std::io::ErrorKind;
use std::path::PathBuf;
use std::time::Duration;

/// An actor's errors. A variant's message does not repeat its source. [`Error::is_configuration`] says whether a restart
/// cannot help.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The learner's address, certificates or token cannot be used.
    #[error(transparent)]
    Access(#[from] comic_proto::AccessError),
    /// One side does not accept the other's token or certificate.
    #[error("the learner at {url} does not accept this process: {message}")]
    Unwelcome {
        /// The learner's address.
        url: String,
        /// What is not accepted.
        message: String,
    },
    /// The learner does not answer.
    #[error("the learner at {url} cannot be reached: {message}")]
    Unreachable {
        /// The learner's address.
        url: String,
        /// Why not.
        message: String,
    },
    /// The learner answers and refuses this actor.
    #[error("the learner at {url} refused this process: {message} (do both programs come from the same release?)")]
    Refused {
        /// The learner's address.
        url: String,
        /// Its reason.
        message: String,
    },
    /// The learner had accepted this process and now refuses it.
    #[error("the learner does not accept actor {actor} again: {message}")]
    Dismissed {
        /// The index that the actor had.
        actor: u64,
        /// The learner's reason.
        message: String,
    },
    /// A newer process of the same name has replaced this one.
    #[error("another process has replaced this actor: {message}")]
    Superseded {
        /// The learner's reason.
        message: String,
    },
    /// This actor does not understand the learner's experiment document.
    #[error("the learner's experiment cannot be used")]
    Experiment(#[from] comic_experiment::Error),
    /// The task's specification does not parse.
    #[error("the learner's task specification cannot be used")]
    Spec(#[from] toml::de::Error),
    /// Both sides computed different sizes from the same document.
    #[error("learner and actor disagree on {what}: build both from the same release")]
    Disagreement {
        /// What they disagree on.
        what: &'static str,
    },
    /// After a reconnect the learner serves another experiment.
    #[error("the learner now serves another experiment than the one this actor runs: start the actor again")]
    Changed,
    /// The process was told to stop before the run was over.
    #[error("told to stop before the run was over")]
    Stopped,
    /// An asset did not arrive as announced.
    #[error("asset `{origin}` did not arrive as the learner announced it: {reason}")]
    Asset {
        /// The asset's name in the experiment.
        origin: String,
        /// What was wrong.
        reason: String,
    },
    /// Parameters from the learner that break the protocol.
    #[error("malformed parameters from the learner: {reason}")]
    Parameters {
        /// What was wrong.
        reason: String,
    },
    /// Parameters that do not fit the experiment's networks.
    #[error("the parameters do not fit the networks of the experiment: {reason}")]
    Misfit {
        /// What was wrong.
        reason: String,
    },
    /// An environment gave a number of derivatives that its unroll has no place for.
    #[error("an unroll with {transitions} transitions got {derivatives} derivatives; please report this defect")]
    Derivatives {
        /// Steps of the environment in the unroll.
        transitions: usize,
        /// Derivatives of the environment.
        derivatives: usize,
    },
    /// A file or directory.
    #[error("cannot use {}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// No place to keep assets.
    #[error("no cache directory is known: name one with --cache, or set HOME or XDG_CACHE_HOME")]
    NoCache,
    /// A checkpoint that cannot be used.
    #[error("checkpoint {}: {reason}", path.display())]
    Checkpoint {
        /// Where it lies.
        path: PathBuf,
        /// Why not.
        reason: String,
    },
    /// A checkpoint of another format.
    #[error("checkpoint {}", path.display())]
    CheckpointFormat {
        /// Where it lies.
        path: PathBuf,
        /// Its format, the one that is read, and the remedy.
        source: comic_experiment::Error,
    },
    /// The command line is wrong.
    #[error("{0}")]
    Usage(String),
    /// A download.
    #[error("cannot fetch {url}: {reason}")]
    Download {
        /// From where.
        url: String,
        /// Why not, and what can be done.
        reason: String,
    },
    /// `clips check` found defects.
    #[error("{clips} of {of} clips have defects")]
    Defects {
        /// Clips with defects.
        clips: usize,
        /// Clips that were checked.
        of: usize,
    },
    /// Reference clips.
    #[error(transparent)]
    Clips(#[from] comic_clips::Error),
    /// The task or its simulator.
    #[error(transparent)]
    Task(#[from] comic_tasks::Error),
    /// libtorch.
    #[error("libtorch failed")]
    Torch(#[from] tch::TchError),
    /// The learner did not answer for the time of `--give-up-after`.
    #[error("the learner at {learner} has not answered for {} s: {reason}", after.as_secs_f64())]
    GaveUp {
        /// Its address.
        learner: String,
        /// The time.
        after: Duration,
        /// What the last attempt met.
        reason: String,
    },
    /// A worker thread ended by a panic; its message went to stderr.
    #[error("a worker thread panicked")]
    WorkerPanicked,
    /// A thread, the runtime, a listener or a signal handler could not be set up.
    #[error("the operating system refused a thread, a socket or a signal handler")]
    Thread(#[source] std::io::Error),
}

impl Error {
    /// The exit code of a program that ends with this error: 3 after giving up on the learner, 2 if the configuration is
    /// wrong, 1 otherwise.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::GaveUp { .. } => 3,
            _ if self.is_configuration() => 2,
            _ => 1,
        }
    }

    /// Whether the configuration is wrong, so that neither a restart nor another machine can help (exit code 2). A disk that
    /// cannot be read and a missing OpenGL are this machine's.
    pub fn is_configuration(&self) -> bool {
        match self {
            Self::Access(_)
            | Self::Unwelcome { .. }
            | Self::Refused { .. }
            | Self::Experiment(_)
            | Self::Spec(_)
            | Self::Disagreement { .. }
            | Self::Misfit { .. }
            | Self::NoCache
            | Self::Checkpoint { .. }
            | Self::CheckpointFormat { .. }
            | Self::Usage(_) => true,
            Self::Clips(error) | Self::Task(comic_tasks::Error::Clips(error)) => match error {
                comic_clips::Error::Unreadable { reason, .. } => {
                    matches!(reason.kind(), ErrorKind::NotFound | ErrorKind::IsADirectory)
                }
                _ => true,
            },
            Self::Task(error) => !matches!(error, comic_tasks::Error::Graphics { .. }),
            Self::Unreachable { .. }
            | Self::Dismissed { .. }
            | Self::Superseded { .. }
            | Self::Changed
            | Self::Stopped
            | Self::Asset { .. }
            | Self::Parameters { .. }
            | Self::Derivatives { .. }
            | Self::File { .. }
            | Self::Download { .. }
            | Self::Defects { .. }
            | Self::Torch(_)
            | Self::GaveUp { .. }
            | Self::WorkerPanicked
            | Self::Thread(_) => false,
        }
    }

    pub(crate) fn file(path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::File { path, source }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_another_machine_may_not_meet_is_no_configuration_error() {
        let unreadable =
            |reason: ErrorKind| comic_clips::Error::Unreadable { path: "walks.h5".into(), reason: reason.into() };
        let failing = || unreadable(ErrorKind::Other);
        let graphics = comic_tasks::Error::Graphics { reason: "no EGL display".into() };
        for error in [Error::Clips(failing()), Error::Task(failing().into()), Error::Task(graphics)] {
            assert_eq!(error.exit_code(), 1, "{error}");
        }
        for error in [comic_clips::Error::NoSources, unreadable(ErrorKind::NotFound)] {
            assert_eq!(Error::Clips(error).exit_code(), 2);
        }
    }
}
