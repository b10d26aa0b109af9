//! The fields of an unroll.

use std::fmt;

use crate::shape::{ELEMENT, UnrollShape};

/// One array of an unroll. The order of the variants is the order in the payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Field {
    /// `[T+1, P]` f32: proprioception, in SI units.
    Proprioception,
    /// `[T+1, X]` f32: the task observation.
    Task,
    /// `[T, Z]` f32: z of the previous step; 0 at the first step of an episode.
    PreviousLatent,
    /// `[T, Z]` f32: the standard-normal noise of z.
    LatentNoise,
    /// `[T, A]` f32: the sampled action, not clipped.
    Action,
    /// `[T, K·A]` f32: mean of each component of the behaviour policy.
    Mean,
    /// `[T, K·A]` f32, positive: standard deviation of each component of the behaviour policy.
    Std,
    /// `[T, K]` f32: ln of the weights of the components, which add up to 1; empty for one component.
    LogWeights,
    /// `[T, A]` f32: the derivative of the coming rewards with respect to the action, by the simulator; empty if the
    /// experiment does not use it.
    ActionGradient,
    /// `[T, R]` f32: one column per reward term.
    Reward,
    /// `[T]` f32 in [0, 1]: 0 if the step terminated the episode, else 1.
    Discount,
    /// `[T]` f32, 1 or 0: whether the row has a transition.
    Valid,
    /// `[T+1]` f32, 1 or 0: whether the row is the first observation of an episode.
    First,
    /// `[1, S]` f32: the recurrent state before the first observation.
    State,
    /// `[T+1]` u32: the index of the clip.
    Clip,
    /// `[T+1, I]` u8: the camera image, rows from the top, red, green, blue.
    Image,
}

impl Field {
    /// All fields in payload order.
    pub const ALL: [Self; 16] = [
        Self::Proprioception,
        Self::Task,
        Self::PreviousLatent,
        Self::LatentNoise,
        Self::Action,
        Self::Mean,
        Self::Std,
        Self::LogWeights,
        Self::ActionGradient,
        Self::Reward,
        Self::Discount,
        Self::Valid,
        Self::First,
        Self::State,
        Self::Clip,
        Self::Image,
    ];

    /// The name in descriptions of layouts and in messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Proprioception => "proprioception",
            Self::Task => "task",
            Self::PreviousLatent => "previous_latent",
            Self::LatentNoise => "latent_noise",
            Self::Action => "action",
            Self::Mean => "mean",
            Self::Std => "std",
            Self::LogWeights => "log_weights",
            Self::ActionGradient => "action_gradient",
            Self::Reward => "reward",
            Self::Discount => "discount",
            Self::Valid => "valid",
            Self::First => "first",
            Self::State => "state",
            Self::Clip => "clip",
            Self::Image => "image",
        }
    }

    /// Rows in an unroll of `length` transitions: T, T + 1 or 1.
    pub fn rows(self, length: usize) -> usize {
        match self {
            Self::Proprioception | Self::Task | Self::First | Self::Clip | Self::Image => length.saturating_add(1),
            Self::State => 1,
            _ => length,
        }
    }

    /// Number of elements per row.
    pub fn width(self, shape: &UnrollShape) -> usize {
        match self {
            Self::Proprioception => shape.proprioception,
            Self::Task => shape.task,
            Self::PreviousLatent | Self::LatentNoise => shape.latent,
            Self::Action => shape.action,
            Self::Mean | Self::Std => shape.components.saturating_mul(shape.action),
            Self::LogWeights if shape.components > 1 => shape.components,
            Self::LogWeights => 0,
            Self::ActionGradient => shape.action_gradient,
            Self::State => shape.state,
            Self::Reward => shape.reward_terms,
            Self::Discount | Self::Valid | Self::First | Self::Clip => 1,
            Self::Image => shape.image,
        }
    }

    /// What stands in a row that holds no transition, where nothing was decided: numbers that no formula can fail on.
    /// `None` where such a row has a meaning of its own, as its observation has.
    pub fn blank(self, shape: &UnrollShape) -> Option<f64> {
        match self {
            Self::PreviousLatent
            | Self::LatentNoise
            | Self::Action
            | Self::Mean
            | Self::ActionGradient
            | Self::Reward => Some(0.0),
            Self::Std => Some(1.0),
            Self::LogWeights => Some(-(shape.components as f64).ln()),
            Self::Proprioception
            | Self::Task
            | Self::Discount
            | Self::Valid
            | Self::First
            | Self::State
            | Self::Clip
            | Self::Image => None,
        }
    }

    /// Type of an element.
    pub(crate) fn element(self) -> &'static str {
        match self {
            Self::Clip => "u32",
            Self::Image => "u8",
            _ => "f32",
        }
    }

    /// Bytes per element.
    pub(crate) fn element_bytes(self) -> usize {
        if self == Self::Image { 1 } else { ELEMENT }
    }
}

impl fmt::Display for Field {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}
