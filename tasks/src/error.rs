//! What can go wrong in building a task.

/// Errors of the tasks. Nothing that happens in an episode is an error: a diverged simulation is an
/// [`Outcome`](crate::Outcome).
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// One of dm_control's XML files is not where it should be.
    #[error("{file}: not found in {tried}; run `cargo xtask setup`, or set COMIC_DM_CONTROL_DIR to its directory")]
    Asset {
        /// The file's name.
        file: String,
        /// The directories that were searched.
        tried: String,
    },
    /// MuJoCo refused the humanoid.
    #[error("{doing}: {reason}; the XML must be that of dm_control 1.0.49, run `cargo xtask setup`")]
    Model {
        /// What was being done.
        doing: &'static str,
        /// MuJoCo's reason.
        reason: String,
    },
    /// A clip could not be read.
    #[error(transparent)]
    Clips(#[from] comic_clips::Error),
    /// Nothing can be drawn.
    #[error(
        "no OpenGL to draw with ({reason}); install Debian's libegl1 and libgl1-mesa-dri, which draw without a display, \
         or leave images out with --set gaps.corridor.vision=off or walls.corridor.vision=off"
    )]
    Graphics {
        /// What MuJoCo or EGL said.
        reason: String,
    },
    /// No window can be opened.
    #[error(
        "no display to open a window on ({reason}); start it in a graphical session, or film with `comic-actor render`, \
         which needs none"
    )]
    Display {
        /// What the window's library said.
        reason: String,
    },
    /// There is nothing to track.
    #[error("clips: no clip to track; name at least one source that has clips")]
    NoClips,
    /// A clip that this task cannot track.
    #[error("clip {clip}: {reason}")]
    Clip {
        /// The clip's name.
        clip: String,
        /// Why, and what to do.
        reason: String,
    },
    /// An observation that the tracking task does not have.
    #[error("tracking.observations: no observation `{name}`; did you mean `{nearest}`?")]
    Observation {
        /// The name given.
        name: String,
        /// The nearest known one.
        nearest: String,
    },
    /// No clip has a frame at which an episode may start.
    #[error(
        "task: no clip has a start with weight above 0; lower tracking.min_steps ({min_steps}) or widen the clips' ranges"
    )]
    NoStarts {
        /// `tracking.min_steps`.
        min_steps: usize,
    },
    /// A start that is not in the clip.
    #[error("clip {clip}, frame {start}: not a frame of the clip's range; {frames} frames from {first} on are")]
    Start {
        /// Index of the clip.
        clip: usize,
        /// The frame asked for.
        start: usize,
        /// First frame of the range.
        first: usize,
        /// Frames in the range from which at least one step can be made.
        frames: usize,
    },
}
