//! Parameters that several tasks have.

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Section};

/// The pose in which an episode begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StartPose {
    /// A frame of the experiment's clips with its velocities. Every frame is equally likely. The frame is turned to the
    /// direction in which the task begins (S: "a suitable motion capture pose").
    Clip,
    /// dm_control's upright pose: every joint at 0, arms out (C).
    Upright,
}

/// What the simulator's derivative of `vmpo.action_gradient` is the derivative of, in tasks of locomotion (D): of the root's
/// speed in the direction in which the task leads, as a reward of its own, and of the head's height. The reward falls from 1 at
/// `speed` by |v − `speed`| / `speed`, rounded near its top, and goes on below 0. The task's own reward stays what it is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GradientOfSpeed {
    /// δ: each later step counts this much less.
    pub decay: f64,
    /// The speed with the largest reward, m/s; 0 is the task's target velocity, or 1 m/s in a task without one.
    pub speed: f64,
    /// Weight w of −w (1.5 m − h) / 0.3 m for a head at a height h below 1.5 m; a walking humanoid's is above. The speed alone
    /// makes the body fall forwards, and its own reward has no slope before a fall.
    pub upright: f64,
}

impl Default for GradientOfSpeed {
    fn default() -> Self {
        Self { decay: 0.95, speed: 0.0, upright: 1.0 }
    }
}

impl GradientOfSpeed {
    pub(super) fn check(&self, section: Section, within: &str) -> Result<(), Fault> {
        let Self { decay, speed, upright } = *self;
        let field = |name: &str| format!("{within}gradient.{name}");
        section.ensure(&field("decay"), decay, (0.0..=1.0).contains(&decay), "must be in [0, 1]")?;
        // Slopes of 1/speed and of upright/0.3 m: larger ones make derivatives that the wire does not take.
        let holds = speed == 0.0 || (0.1..=100.0).contains(&speed);
        section.ensure(&field("speed"), speed, holds, "must be 0, which is the task's own, or from 0.1 to 100 m/s")?;
        let holds = (0.0..=100.0).contains(&upright);
        section.ensure(&field("upright"), upright, holds, "must be in [0, 100]")
    }
}

/// How the egocentric camera's images are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Vision {
    /// No images.
    Off,
    /// Without shadows and without multisampling, and round bodies have fewer faces (D).
    Fast,
    /// As dm_control draws them: a 4096² shadow map, four samples a pixel (C). In software this takes more than
    /// twenty times as long.
    Full,
}
