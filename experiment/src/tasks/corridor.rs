//! What both corridors share.

use serde::{Deserialize, Serialize};

use super::{GradientOfSpeed, StartPose, Vision};
use crate::fault::{Fault, POSITIVE, Section, positive};

/// What both corridors share (`dm_control/locomotion/tasks/corridors.py`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Corridor {
    /// Length, m (S).
    pub length: f64,
    /// Width, m (S).
    pub width: f64,
    /// Speed with the largest reward, m/s. The reward falls linearly to 0 at speed 0 and at twice this speed (S).
    pub target_velocity: f64,
    /// An end effector below this height ends the episode, m (C).
    pub fall_height: f64,
    /// Seconds an episode lasts (S).
    pub time_limit: f64,
    /// The pose in which an episode begins, 0.5 m into the corridor.
    pub start_pose: StartPose,
    /// Control steps after which the next reset draws a new arena. With 0 every reset draws one, as in dm_control.
    /// Compiling an arena takes as long as about twenty steps (D).
    pub arena_steps: u32,
    /// How the egocentric camera's images are drawn.
    pub vision: Vision,
    /// What actors differentiate if `vmpo.action_gradient` is not 0: the speed along the corridor, and the head's height.
    pub gradient: GradientOfSpeed,
}

impl Default for Corridor {
    fn default() -> Self {
        Self {
            length: 100.0,
            width: 10.0,
            target_velocity: 3.0,
            fall_height: -0.5,
            time_limit: 45.0,
            start_pose: StartPose::Clip,
            arena_steps: 512,
            vision: Vision::Fast,
            gradient: GradientOfSpeed::default(),
        }
    }
}

/// Names of the reward terms of both corridors.
pub(super) const REWARD_TERMS: [&str; 1] = ["velocity"];
/// The task observation of both corridors: the root's height, m.
pub(super) const OBSERVATIONS: [(&str, usize); 1] = [("body_height", 1)];

impl Corridor {
    /// An episode is a success if the humanoid comes this share of the way that `target_velocity` allows in `time_limit` (D).
    pub const SUCCESS_SHARE: f64 = 0.5;

    /// # Errors
    /// The first field with a meaningless value.
    pub(super) fn check(&self, section: Section) -> Result<(), Fault> {
        let (length, width, fall) = (self.length, self.width, self.fall_height);
        section.ensure("corridor.length", length, (10.0..=1000.0).contains(&length), "must be 10 to 1000 metres")?;
        section.ensure("corridor.width", width, (1.0..=1000.0).contains(&width), "must be 1 to 1000 metres")?;
        let velocity = self.target_velocity;
        section.ensure("corridor.target_velocity", velocity, positive(velocity), POSITIVE)?;
        section.ensure("corridor.fall_height", fall, fall.is_finite(), "must be a height in metres")?;
        section.seconds("corridor.time_limit", self.time_limit)?;
        self.gradient.check(section, "corridor.")
    }
}
