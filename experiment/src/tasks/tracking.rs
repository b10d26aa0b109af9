//! Multi-clip motion-capture tracking.

use serde::{Deserialize, Serialize};

use super::TaskParameters;
use crate::body::{ACTION_SIZE, BODIES};
use crate::fault::{Fault, POSITIVE, Section};

/// Multi-clip motion-capture tracking (`dm_control/locomotion/tasks/reference_pose/tracking.py`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Tracking {
    /// The reference frames in the observation, counted from the current frame (S: the next five). 0 is the current frame:
    /// with it, frames 1 and 2 tell the reference's velocity exactly (D).
    pub reference_steps: Vec<usize>,
    /// Smallest number of frames from an episode's start to the clip's end (dm_control: 10). No episode starts in the last
    /// `max(reference_steps) + min_steps` frames. 5 gives the supplement's "last 10 frames".
    pub min_steps: usize,
    /// τ: an episode ends with discount 0 when its termination error is larger (S).
    pub termination_threshold: f64,
    /// The formula of the termination error.
    pub termination_error: TerminationError,
    /// Seconds after which an episode is truncated (dm_control's example: 30).
    pub time_limit: f64,
    /// Start every episode at its clip's first frame instead of a random one.
    pub always_start_at_clip_start: bool,
    /// Share of the starts of training that are drawn by failures (D, after BeyondMimic's adaptive sampling): at the places
    /// where the environment's own episodes failed, and up to 1.5 s before them. The others are drawn as without failures.
    /// Each environment counts its own episodes, so lockstep stays reproducible. Evaluations count for nothing.
    pub failure_starts: f64,
    /// Noise of the starts of training, as a factor (D): a start of training differs from its frame by normal numbers whose
    /// standard deviations are this number times 0.1 rad (joint angles), 0.5 rad/s (velocities of the joints and angular
    /// velocities of the root) and 0.3 m/s (velocity of the root). A policy that was never off its reference cannot come back
    /// to it. Evaluations have no such noise.
    pub start_noise: f64,
    /// Set the actuators' filter state to the reference pose at reset. dm_control sets it to 0, the middle of the range.
    pub preset_actuators: bool,
    /// Task observations, by dm_control's names without `walker/`, in this order
    /// (MoCapAct's choice: the supplement's "relative target positions and orientations in the local frame").
    pub observations: Vec<String>,
    /// The derivative of the reward that actors compute if `vmpo.action_gradient` is not 0.
    pub gradient: GradientOfReward,
}

/// What the simulator's derivative of `vmpo.action_gradient` is the derivative of (D): the rewards of the coming steps, with
/// softer exponents, a barrier before the termination threshold, and a term for the root's velocity.
///
/// A reward term w exp(−c Δ²) counts as w exp(−c p Δ²). A power p below 1 gives it a slope where the error is so large that
/// the term itself is flat. The termination term ½ (1 − ε / τ) counts as ½ ln(1 − ε / τ), which falls steeply before a fall.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GradientOfReward {
    /// δ: each later step counts this much less.
    pub decay: f64,
    /// p of the term `appendages`.
    pub appendages: f64,
    /// p of `body_quaternions`.
    pub body_quaternions: f64,
    /// p of `center_of_mass`.
    pub center_of_mass: f64,
    /// p of `joints_velocity`.
    pub joints_velocity: f64,
    /// Weight w of w exp(−½ Σ (Δ / scale)²) for the root's velocity. The reward has no such term, but a body that loses its
    /// balance differs there first. The scales are 0.3 m/s and 1.5 rad/s.
    pub root_velocity: f64,
}

impl Default for GradientOfReward {
    fn default() -> Self {
        Self {
            decay: 0.95,
            appendages: 0.25,
            body_quaternions: 1.0,
            center_of_mass: 1.0,
            joints_velocity: 0.2,
            root_velocity: 0.03,
        }
    }
}

impl GradientOfReward {
    /// p of every term, in the order of [`TRACKING_REWARD_TERMS`]. The term `termination` has none.
    pub fn powers(&self) -> [f64; TRACKING_REWARD_TERMS.len()] {
        let Self { appendages, body_quaternions, center_of_mass, joints_velocity, .. } = self;
        [*appendages, *body_quaternions, *center_of_mass, *joints_velocity, 1.0]
    }
}

impl Default for Tracking {
    fn default() -> Self {
        Self {
            reference_steps: vec![1, 2, 3, 4, 5],
            min_steps: 10,
            termination_threshold: 0.3,
            termination_error: TerminationError::DmControl,
            time_limit: 30.0,
            always_start_at_clip_start: false,
            failure_starts: 0.0,
            start_noise: 0.0,
            preset_actuators: false,
            observations: ["body_height", "reference_rel_bodies_pos_local", "reference_rel_bodies_quats"]
                .map(String::from)
                .to_vec(),
            gradient: GradientOfReward::default(),
        }
    }
}

/// ε, the termination error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TerminationError {
    /// ½·mean|Δ body positions| + ½·mean|Δ joints|: what the published code computes.
    DmControl,
    /// ‖Δ body positions‖₁ + ‖Δ joints‖₁, summed: the supplement's text, taken literally.
    Supplement,
}

impl TaskParameters for Tracking {
    fn check(&self, section: Section) -> Result<(), Fault> {
        let Self { reference_steps, min_steps, termination_threshold, time_limit, observations, .. } = self;
        section.ensure(
            "reference_steps",
            reference_steps,
            (1..=64).contains(&reference_steps.len()) && reference_steps.iter().all(|step| *step <= 1000),
            "must be 1 to 64 numbers of frames ahead, each 0 to 1000",
        )?;
        section.ensure("min_steps", min_steps, (1..=100_000).contains(min_steps), "must be 1 to 100000")?;
        section.ensure("termination_threshold", termination_threshold, *termination_threshold > 0.0, POSITIVE)?;
        section.ensure("time_limit", time_limit, *time_limit > 0.0, "must be positive seconds")?;
        section.deviation("start_noise", self.start_noise)?;
        let share = self.failure_starts;
        section.ensure("failure_starts", share, (0.0..=1.0).contains(&share), "must be 0 to 1")?;
        let choice = share == 0.0 || !self.always_start_at_clip_start;
        let remedy = "must be 0 with tracking.always_start_at_clip_start, which leaves no start to choose";
        section.ensure("failure_starts", share, choice, remedy)?;
        let GradientOfReward { decay, root_velocity, .. } = self.gradient;
        section.ensure("gradient.decay", decay, (0.0..=1.0).contains(&decay), "must be in [0, 1]")?;
        for (name, power) in TRACKING_REWARD_TERMS.iter().zip(self.gradient.powers()) {
            section.ensure(&format!("gradient.{name}"), power, power > 0.0 && power <= 1.0, "must be in (0, 1]")?;
        }
        let holds = root_velocity >= 0.0 && root_velocity.is_finite();
        section.ensure("gradient.root_velocity", root_velocity, holds, "must be 0 or more")?;
        for (index, name) in observations.iter().enumerate() {
            let known = tracking_observation_size(name, 1).is_some();
            let remedy = format!("must be one of {}", TRACKING_OBSERVATIONS.join(", "));
            section.ensure(&format!("observations.{index}"), name, known, remedy)?;
        }
        Ok(())
    }

    fn reward_terms(&self) -> &'static [&'static str] {
        &TRACKING_REWARD_TERMS
    }

    fn observations(&self) -> Result<Vec<(String, usize)>, String> {
        let steps = self.reference_steps.len();
        let sized = |name: &String| tracking_observation_size(name, steps).map(|size| (name.clone(), size));
        self.observations.iter().map(|name| sized(name).ok_or_else(|| name.clone())).collect()
    }

    fn max_reward(&self) -> f64 {
        TRACKING_MAX_REWARD
    }

    fn follows_clips(&self) -> bool {
        true
    }
}

/// Reward terms of the tracking task, in the order of dm_control's sorted reward channels.
pub const TRACKING_REWARD_TERMS: [&str; 5] =
    ["appendages", "body_quaternions", "center_of_mass", "joints_velocity", "termination"];
/// The largest value of each term, in the same order (`reference_pose/rewards.py`: `comic_reward_fn`).
pub const TRACKING_TERM_LIMITS: [f64; 5] = [0.075, 0.325, 0.05, 0.5, 0.5];
/// The largest reward of a tracking step: 0.5 + 0.5·(0.1 + 1 + 0.15 + 0.65).
pub const TRACKING_MAX_REWARD: f64 = 1.45;

/// Every task observation of the tracking task, by dm_control's name without `walker/`.
pub const TRACKING_OBSERVATIONS: [&str; 14] = [
    "body_height",
    "appendages_pos",
    "sensors_accelerometer",
    "velocimeter_control",
    "gyro_control",
    "joints_vel_control",
    "time_in_clip",
    "reference_rel_joints",
    "reference_rel_bodies_pos_local",
    "reference_rel_bodies_quats",
    "reference_ego_bodies_quats",
    "reference_rel_root_quat",
    "reference_rel_root_pos_local",
    "reference_appendages_pos",
];

/// Length of one of [`TRACKING_OBSERVATIONS`] with `steps` reference steps; `None` for any other name.
pub fn tracking_observation_size(name: &str, steps: usize) -> Option<usize> {
    Some(match name {
        "body_height" | "time_in_clip" => 1,
        "appendages_pos" => 15,
        "sensors_accelerometer" | "velocimeter_control" | "gyro_control" => 3,
        "joints_vel_control" => ACTION_SIZE,
        "reference_rel_joints" => steps * ACTION_SIZE,
        "reference_rel_bodies_pos_local" => steps * BODIES * 3,
        "reference_rel_bodies_quats" | "reference_ego_bodies_quats" => steps * BODIES * 4,
        "reference_rel_root_quat" => steps * 4,
        "reference_rel_root_pos_local" => steps * 3,
        "reference_appendages_pos" => steps * 15,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_terms_largest_values_add_up_to_the_largest_reward() {
        assert!((TRACKING_TERM_LIMITS.iter().sum::<f64>() - TRACKING_MAX_REWARD).abs() < 1e-12);
    }
}
