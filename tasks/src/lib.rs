//! The humanoid and the tasks it is trained on: observation, reward, termination. Knows neither libtorch nor the wire.
//!
//! # Layout
//! - [`Environment`] is what an actor steps; [`TrackingTask`] is what all environments of a process share (compiled
//!   models, reference clips), [`TrackingEnvironment`] one simulation of it.
//! - [`humanoid`] builds the compiled model from dm_control's XML; [`floor`] is the same physics without a task, the
//!   yardstick of the benchmarks.
//!
//! The task is dm_control's `MultiClipMocapTracking`: the state of the simulation is equal bit for bit, observations
//! and rewards to 1e-12 (`tests/parity_tracking.rs`).

mod environment;
mod error;
mod features;
pub mod floor;
pub mod humanoid;
mod observation;
mod physics;
mod quaternion;
mod reference;
mod reward;
mod silence;
mod starts;
mod tracking;
mod walker;

pub use environment::TrackingEnvironment;
pub use error::Error;
pub use starts::ClipStarts;
pub use tracking::TrackingTask;

/// The most reward terms a task has.
pub const MAX_REWARD_TERMS: usize = 5;

/// One environment of any task.
pub trait Environment: Send {
    /// Draws a start and begins an episode there; its first observation is ready.
    fn reset(&mut self);

    /// One control step. `action` is in control order, −1 … 1 per joint's range; values beyond are clipped by MuJoCo.
    /// A value that is not finite, or an action of another length, diverges.
    fn step(&mut self, action: &[f32]) -> Step;

    /// Writes the observation after the last reset or step; zeros when that step diverged.
    ///
    /// # Panics
    /// When the slices are shorter than [`TaskSpec`](comic_experiment::TaskSpec) says.
    fn observe(&self, proprioception: &mut [f32], task: &mut [f32]);

    /// Where the current episode began.
    fn episode(&self) -> Episode;

    /// The action whose servos aim at the pose of the next reference frame: a demonstration, and a baseline.
    fn servo_action(&self, action: &mut [f32]);
}

/// What one control step gave.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// The reward's terms, each with its weight, in the order of the task's names; they add up to the reward.
    pub reward_terms: [f64; MAX_REWARD_TERMS],
    /// 0 when the episode ended in failure, else 1.
    pub discount: f64,
    /// Whether and how the episode ended.
    pub outcome: Outcome,
}

impl Step {
    /// The reward: the sum of its terms.
    pub fn reward(&self) -> f64 {
        self.reward_terms.iter().sum()
    }
}

/// How an episode stands after a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// It goes on.
    Running,
    /// Failure: the termination error is beyond the threshold. Discount 0.
    Terminated,
    /// The clip or the time is over. Discount 1: what would have followed still counts.
    Truncated,
    /// MuJoCo warned, or a number is not finite. Reward 0, discount 0.
    Diverged,
}

/// Where an episode began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Episode {
    /// Index of the clip.
    pub clip: usize,
    /// The frame it started at, counted from the clip's own first frame.
    pub start: usize,
    /// Control steps from there to the clip's end: the most the episode can last, time limit apart.
    pub steps_left: usize,
}
