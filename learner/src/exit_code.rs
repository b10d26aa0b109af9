//! The exit code of `comic-learner` after an error.

use crate::error::Error;
use crate::world;

/// The exit code of a learner that was told to stop before the run was over, and wrote its checkpoint. A Kubernetes Job counts 0
/// as done.
pub const STOPPED: u8 = 4;

/// The exit code of a learner that lost another one of its run, did not find it, or found one with another world size: another process
/// failed, not this one.
const LOST: u8 = 5;

impl Error {
    /// The program's exit code: 2 when starting again cannot help, because the configuration is wrong, 5 when another rank is at fault,
    /// and 1 otherwise.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Configuration(_)
            | Self::Experiment(_)
            | Self::Clips(_)
            | Self::Access(_)
            | Self::Networks(comic_networks::Error::Experiment(_)) => 2,
            Self::Within { source, .. } => source.exit_code(),
            // Another world size may be that of a former run, whose rank 0 still ends.
            Self::World(
                world::Error::Lost { .. }
                | world::Error::Meeting { .. }
                | world::Error::Sizes { .. }
                | world::Error::Unreachable { .. },
            ) => LOST,
            Self::World(_)
            | Self::Networks(_)
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
