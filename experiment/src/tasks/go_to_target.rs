//! Walking to targets.

use serde::{Deserialize, Serialize};

use super::{GradientOfSpeed, StartPose, TaskParameters, fixed};
use crate::fault::{AT_LEAST_ONE, Fault, Section};

/// Walk to targets (`dm_control/locomotion/tasks/go_to_target.py`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GoToTarget {
    /// Half the width of the square in which targets and starts are drawn, m (C: half of the arena's 8).
    pub half_width: f64,
    /// The target is reached when the horizontal distance is smaller than this, m (S).
    pub tolerance: f64,
    /// Steps within the tolerance after which the target moves (S).
    pub steps_at_target: u32,
    /// Whether the target moves (S; dm_control's default: no).
    pub moving_target: bool,
    /// Whether episodes begin with a random heading (S: "randomly initialized"; dm_control's default: no).
    pub random_heading: bool,
    /// Keep the count of rewarded steps for the next episode, as dm_control's code does. Otherwise it starts at 0 (D).
    pub carry_count: bool,
    /// Seconds an episode lasts (S).
    pub time_limit: f64,
    /// The pose in which an episode begins.
    pub start_pose: StartPose,
    /// What actors differentiate if `vmpo.action_gradient` is not 0: the speed towards the target while it is not reached, and
    /// the head's height.
    pub gradient: GradientOfSpeed,
}

impl Default for GoToTarget {
    fn default() -> Self {
        Self {
            half_width: 4.0,
            tolerance: 1.0,
            steps_at_target: 10,
            moving_target: true,
            random_heading: true,
            carry_count: false,
            time_limit: 25.0,
            start_pose: StartPose::Clip,
            gradient: GradientOfSpeed::default(),
        }
    }
}

impl TaskParameters for GoToTarget {
    fn check(&self, section: Section) -> Result<(), Fault> {
        section.metres("half_width", self.half_width)?;
        section.metres("tolerance", self.tolerance)?;
        section.ensure("steps_at_target", self.steps_at_target, self.steps_at_target > 0, AT_LEAST_ONE)?;
        section.seconds("time_limit", self.time_limit)?;
        self.gradient.check(section, "")
    }

    fn reward_terms(&self) -> &'static [&'static str] {
        &["target"]
    }

    fn observations(&self) -> Result<Vec<(String, usize)>, String> {
        // In the root's frame, m.
        Ok(fixed(&[("target", 3)]))
    }

    fn max_reward(&self) -> f64 {
        1.0
    }
}
