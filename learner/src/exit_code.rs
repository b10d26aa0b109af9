//! The exit code of `comic-learner` after an error.

use crate::error::Error;

impl Error {
    /// The program's exit code: 2 when starting again cannot help, because the configuration is wrong, and 1 otherwise.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Configuration(_)
            | Self::Experiment(_)
            | Self::Clips(_)
            | Self::Access(_)
            | Self::Networks(comic_networks::Error::Experiment(_)) => 2,
            Self::Within { source, .. } => source.exit_code(),
            Self::Networks(_)
            | Self::Accounting(_)
            | Self::Update(_)
            | Self::Torch(_)
            | Self::Device(_)
            | Self::Diverged(_)
            | Self::Checkpoint(_)
            | Self::Json { .. }
            | Self::File { .. }
            | Self::System { .. }
            | Self::Server(_)
            | Self::Certificate(_)
            | Self::NoAnswer(_)
            | Self::Stopped
            | Self::Panicked(_)
            | Self::Defect(_) => 1,
        }
    }
}
