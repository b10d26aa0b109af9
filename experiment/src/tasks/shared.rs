//! Parameters that several tasks have.

use serde::{Deserialize, Serialize};

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

/// How the egocentric camera's images are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Vision {
    /// No images.
    Off,
    /// Without shadows and without multisampling (D).
    Fast,
    /// As dm_control draws them: a 4096² shadow map, four samples a pixel (C). In software this takes about twenty times
    /// as long.
    Full,
}
