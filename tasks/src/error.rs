//! What can go wrong when a task is built or drawn.

use comic_experiment::TRACKING_OBSERVATIONS;
use mujoco_rs::prelude::MjEditError;

/// Errors of the tasks. Events of an episode are not errors: a divergence is an `Outcome`.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// MuJoCo refused the humanoid.
    #[error(
        "{doing}: {reason}; this program was built with other XML than that of dm_control 1.0.49; build it again after `cargo xtask setup`"
    )]
    Model {
        /// The step that failed.
        doing: &'static str,
        /// MuJoCo's reason.
        reason: String,
    },
    /// A clip could not be read.
    #[error(transparent)]
    Clips(#[from] comic_clips::Error),
    /// There is no OpenGL.
    #[error(
        "no OpenGL to draw with ({reason}); install Debian's libegl1 and libgl1-mesa-dri, which need no display, \
         or turn images off with --set gaps.corridor.vision=off or walls.corridor.vision=off"
    )]
    Graphics {
        /// The message of MuJoCo or EGL.
        reason: String,
    },
    /// No window can be opened.
    #[error(
        "no display for a window ({reason}); start the program in a graphical session, or make a film with \
         `comic-actor render`, which needs no display"
    )]
    Display {
        /// The message of the window's library.
        reason: String,
    },
    /// The simulator's derivative was asked of a model that it cannot differentiate.
    #[error(
        "vmpo.action_gradient: the derivative is of the V2020 humanoid alone, integrated by Euler's method with implicit \
         damping; set it to 0"
    )]
    NoDerivative,
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
    /// A start that the task does not have.
    #[error(
        "clip {clip}: no episode starts at frame {start}; the clip has {frames} start frames from frame {first} on"
    )]
    Start {
        /// Index of the clip.
        clip: usize,
        /// The frame asked for.
        start: usize,
        /// The first start frame.
        first: usize,
        /// Number of start frames.
        frames: usize,
    },
}

/// MuJoCo refused an edit of the model while `doing` this.
pub(crate) fn refused(doing: &'static str) -> impl Fn(MjEditError) -> Error {
    move |error| Error::Model { doing, reason: error.to_string() }
}

/// The XML does not have an element that the edits need.
pub(crate) fn missing(kind: &'static str, name: &str) -> Error {
    Error::Model { doing: "editing the humanoid", reason: format!("the XML has no {kind} `{name}`") }
}

/// The tracking task has no observation with this name.
pub(crate) fn unknown_observation(name: String) -> Error {
    let likeness = |known: &str| strsim::jaro_winkler(known, &name);
    let nearest = TRACKING_OBSERVATIONS.into_iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)));
    Error::Observation { nearest: nearest.unwrap_or_default().to_string(), name }
}
