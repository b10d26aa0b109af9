//! Getting up and standing.

use serde::{Deserialize, Serialize};

use super::{StartPose, TaskParameters, fixed};
use crate::fault::{Fault, Section};

/// Get up and stand (supplement 1.3; no published code). Numbers without a mark are decisions of this project.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GetUp {
    /// Share of the episodes that begin with a lying humanoid (S: "about 5%"). The others begin with a standing humanoid
    /// above the ground.
    pub lying_share: f64,
    /// Where lying poses come from.
    pub lying_pose: LyingPose,
    /// Height of the head with the largest reward, m: the height in the upright pose.
    pub target_height: f64,
    /// Range of a standing start's height above the ground, m.
    pub drop_height: [f64; 2],
    /// Standard deviation of a standing start's tilt about a random horizontal axis, rad.
    pub tilt: f64,
    /// Standard deviation of a standing start's joint angles around the start pose, rad.
    pub joint_noise: f64,
    /// Standard deviation of each component of the root's velocity in a standing start, m/s.
    pub velocity_noise: f64,
    /// Standard deviation of the root's angular velocities and of the joints' velocities in a standing start, rad/s.
    pub angular_velocity_noise: f64,
    /// The pose of standing starts, before noise is added.
    pub start_pose: StartPose,
    /// Seconds an episode lasts (S).
    pub time_limit: f64,
    /// Seconds an episode of training lasts (D); 0 is the same as `time_limit`. A body that cannot stand yet falls within a
    /// second, and lies for the rest of the episode: shorter episodes give more experience of standing. Evaluations last
    /// `time_limit`.
    pub training_time_limit: f64,
    /// What actors differentiate if `vmpo.action_gradient` is not 0.
    pub gradient: GradientOfStanding,
}

impl GetUp {
    /// An episode is a success if the head ends at least at this share of `target_height` (D): 1.63 m by default.
    pub const STANDING_SHARE: f64 = 0.9;
}

/// What the simulator's derivative of `vmpo.action_gradient` is the derivative of (D): the rewards of the coming steps, and
/// three terms of standing. A body begins to fall long before its head is lower, so the reward alone says nothing of balance.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GradientOfStanding {
    /// δ: each later step counts this much less.
    pub decay: f64,
    /// Weight w of w exp(−½ (d / 0.2 m)²), for the horizontal distance d from the middle of the feet to the centre of mass
    /// where its velocity carries it in 0.32 s: the extrapolated centre of mass (Hof 2005), with the root's velocity.
    pub balance: f64,
    /// Weight w of w exp(−½ Σ (v / scale)²) for the root's velocities; the scales are 0.5 m/s and 2 rad/s.
    pub stillness: f64,
    /// Weight w of w exp(−½ Σ q² / 56 / (0.3 rad)²) for the joint angles q, which are 0 in the upright pose.
    pub pose: f64,
}

impl Default for GradientOfStanding {
    fn default() -> Self {
        Self { decay: 0.95, balance: 0.5, stillness: 0.2, pose: 0.3 }
    }
}

impl Default for GetUp {
    fn default() -> Self {
        Self {
            lying_share: 0.05,
            lying_pose: LyingPose::Simulated,
            target_height: 1.808,
            drop_height: [0.02, 0.15],
            tilt: 0.15,
            joint_noise: 0.1,
            velocity_noise: 0.3,
            angular_velocity_noise: 0.5,
            start_pose: StartPose::Upright,
            time_limit: 8.0,
            training_time_limit: 0.0,
            gradient: GradientOfStanding::default(),
        }
    }
}

/// Where lying poses come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LyingPose {
    /// The humanoid falls from a random pose and is simulated for three seconds without control.
    Simulated,
    /// The first frame of each clip of the experiment. It is meant for clips of getting up: dm_control's subset `get_up`.
    Clips,
}

impl TaskParameters for GetUp {
    fn check(&self, section: Section) -> Result<(), Fault> {
        let share = self.lying_share;
        section.ensure("lying_share", share, (0.0..=1.0).contains(&share), "must be in [0, 1]")?;
        section.metres("target_height", self.target_height)?;
        section.range("drop_height", self.drop_height, [0.0, 10.0])?;
        section.deviation("tilt", self.tilt)?;
        section.deviation("joint_noise", self.joint_noise)?;
        section.deviation("velocity_noise", self.velocity_noise)?;
        section.deviation("angular_velocity_noise", self.angular_velocity_noise)?;
        section.seconds("time_limit", self.time_limit)?;
        let (training, longest) = (self.training_time_limit, self.time_limit);
        let remedy = "must be 0, which is time_limit, or positive seconds up to time_limit";
        section.ensure("training_time_limit", training, (0.0..=longest).contains(&training), remedy)?;
        let GradientOfStanding { decay, balance, stillness, pose } = self.gradient;
        section.ensure("gradient.decay", decay, (0.0..=1.0).contains(&decay), "must be in [0, 1]")?;
        for (name, weight) in [("balance", balance), ("stillness", stillness), ("pose", pose)] {
            let holds = weight >= 0.0 && weight.is_finite();
            section.ensure(&format!("gradient.{name}"), weight, holds, "must be 0 or more")?;
        }
        Ok(())
    }

    fn reward_terms(&self) -> &'static [&'static str] {
        &["height"]
    }

    fn observations(&self) -> Result<Vec<(String, usize)>, String> {
        // The root's height, m.
        Ok(fixed(&[("body_height", 1)]))
    }

    fn max_reward(&self) -> f64 {
        1.0
    }
}
