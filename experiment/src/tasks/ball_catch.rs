//! Ball catching.

use serde::{Deserialize, Serialize};

use super::{StartPose, TaskParameters, fixed};
use crate::fault::{AT_LEAST_ONE, Fault, POSITIVE, Section, positive};

/// Ball catching (supplement 1.3; no published code). Numbers without a mark are decisions of this project.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BallCatch {
    /// Range of the ball's radius, m; random per episode (S).
    pub radius: [f64; 2],
    /// Range of its mass, kg; random per episode (S).
    pub mass: [f64; 2],
    /// Number of balls that are compiled when the task is built. An episode uses one of them.
    pub balls: usize,
    /// Range of the distance in front of the humanoid at which the ball starts, m.
    pub distance: [f64; 2],
    /// Range of the ball's start to the side of the straight line ahead, m.
    pub lateral: [f64; 2],
    /// Range of the height at which the ball starts, m.
    pub height: [f64; 2],
    /// Distance of the aim in front of the chest, m. The ball is thrown at the aim.
    pub aim_distance: f64,
    /// Range of the aim to the side of the straight line ahead, m.
    pub aim_lateral: [f64; 2],
    /// Range of the aim's height, m.
    pub aim_height: [f64; 2],
    /// Range of the time of flight to the aim, s. The throw goes upwards and towards the humanoid (S).
    pub flight_time: [f64; 2],
    /// Standard deviation of each component of the ball's angular velocity, rad/s; random per episode (S).
    pub spin: f64,
    /// Reward when the ball touches the ground or the head, which ends the episode (S).
    pub failure_reward: f64,
    /// Reward for each hand that touches the ball with its front, and penalty for its back (S).
    pub touch_reward: f64,
    /// Largest reward for standing (S: the get-up reward, scaled).
    pub standing_reward: f64,
    /// The ball is caught after the humanoid has held it for this many steps.
    pub hold_steps: u32,
    /// Largest reward for walking to the target after the ball is caught.
    pub walking_reward: f64,
    /// Speed towards the target with the largest walking reward, m/s.
    pub walking_speed: f64,
    /// Distance of the target, straight ahead, m.
    pub target_distance: f64,
    /// Height of the head with the largest standing reward, m: the height in the upright pose.
    pub target_height: f64,
    /// The pose in which an episode begins (S: a standing one).
    pub start_pose: StartPose,
    /// Seconds an episode lasts (S).
    pub time_limit: f64,
}

impl Default for BallCatch {
    fn default() -> Self {
        Self {
            radius: [0.08, 0.15],
            mass: [0.3, 1.5],
            balls: 32,
            distance: [2.0, 3.0],
            lateral: [-0.3, 0.3],
            height: [0.8, 1.3],
            aim_distance: 0.35,
            aim_lateral: [-0.2, 0.2],
            aim_height: [1.1, 1.5],
            flight_time: [0.6, 0.9],
            spin: 3.0,
            failure_reward: -1.0,
            touch_reward: 0.01,
            standing_reward: 0.01,
            hold_steps: 10,
            walking_reward: 0.01,
            walking_speed: 1.0,
            target_distance: 3.0,
            target_height: 1.808,
            start_pose: StartPose::Upright,
            time_limit: 6.0,
        }
    }
}

impl TaskParameters for BallCatch {
    fn check(&self, section: Section) -> Result<(), Fault> {
        section.range("radius", self.radius, [0.01, 1.0])?;
        section.range("mass", self.mass, [0.001, 1000.0])?;
        section.ensure("balls", self.balls, (1..=1024).contains(&self.balls), "must be 1 to 1024")?;
        section.range("distance", self.distance, [0.0, 100.0])?;
        section.range("lateral", self.lateral, [-100.0, 100.0])?;
        section.range("height", self.height, [0.0, 100.0])?;
        section.ensure("aim_distance", self.aim_distance, self.aim_distance.abs() <= 100.0, "must be within 100 m")?;
        section.range("aim_lateral", self.aim_lateral, [-100.0, 100.0])?;
        section.range("aim_height", self.aim_height, [0.0, 100.0])?;
        section.range("flight_time", self.flight_time, [0.01, 100.0])?;
        section.deviation("spin", self.spin)?;
        for (name, reward) in [
            ("failure_reward", self.failure_reward),
            ("touch_reward", self.touch_reward),
            ("standing_reward", self.standing_reward),
            ("walking_reward", self.walking_reward),
        ] {
            section.ensure(name, reward, reward.abs() <= 1000.0, "must be within ±1000")?;
        }
        section.ensure("hold_steps", self.hold_steps, self.hold_steps > 0, AT_LEAST_ONE)?;
        section.ensure("walking_speed", self.walking_speed, positive(self.walking_speed), POSITIVE)?;
        let distance = self.target_distance;
        section.ensure("target_distance", distance, distance.abs() <= 1000.0, "must be within 1000 m")?;
        section.metres("target_height", self.target_height)?;
        section.seconds("time_limit", self.time_limit)
    }

    fn reward_terms(&self) -> &'static [&'static str] {
        &["failure", "touch", "standing", "walking"]
    }

    fn observations(&self) -> Result<Vec<(String, usize)>, String> {
        // In the root's frame: m, m/s, rad/s, m, m.
        Ok(fixed(&[
            ("ball_position", 3),
            ("ball_velocity", 3),
            ("ball_angular_velocity", 3),
            ("ball_radius", 1),
            ("target", 3),
        ]))
    }

    fn max_reward(&self) -> f64 {
        2.0 * self.touch_reward + self.standing_reward + self.walking_reward
    }
}
