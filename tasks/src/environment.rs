//! What actors, evaluation and rendering know of any task: [`Task`], [`Environment`] and [`Simulated`].

use std::fmt::Debug;
use std::ops::Range;
use std::sync::Arc;

use comic_experiment::TaskSpec;
use mujoco_rs::prelude::MjModel;

use crate::achievement::Achievement;
use crate::error::Error;
use crate::physics::Simulation;

/// The largest number of reward terms of any task.
pub const MAX_REWARD_TERMS: usize = 5;

/// What all environments of a task share. It never changes.
pub trait Task: Debug + Send + Sync {
    /// Sizes and names for networks, wire and learner.
    fn spec(&self) -> &TaskSpec;

    /// Where episodes can start: frames of clips. In a task without clips, a start is the seed of an episode.
    fn starts(&self) -> &[ClipStarts];

    /// Length of a control step, s.
    fn control_timestep(&self) -> f64;

    /// A new environment after its first reset. `seed` decides all its random numbers.
    ///
    /// # Errors
    /// The arena cannot be built.
    fn environment(self: Arc<Self>, seed: u64) -> Result<Box<dyn Simulated>, Error>;
}

/// The start frames of one clip.
#[derive(Clone, Debug, PartialEq)]
pub struct ClipStarts {
    /// Index of the clip.
    pub clip: usize,
    /// Frames at which an episode can start, counted from the clip's first frame. All are equally likely.
    pub frames: Range<usize>,
    /// Probability that an episode starts at one of these frames.
    pub probability: f64,
}

/// One environment of any task, as a policy uses it.
pub trait Environment: Debug + Send {
    /// Draws a start and begins an episode there. The first observation is then ready.
    fn reset(&mut self);

    /// Begins an episode at one of the task's [starts](Task::starts). In tracking `start` is a frame, counted from the
    /// clip's first frame. In other tasks it is the seed of the episode.
    ///
    /// # Errors
    /// [`Error::Start`]: the task does not have this start.
    fn reset_to(&mut self, clip: usize, start: usize) -> Result<(), Error>;

    /// One control step. `action` is in control order; −1 … 1 is a joint's range, and MuJoCo clips larger values. The step
    /// diverges when a value is not finite or the length is wrong.
    fn step(&mut self, action: &[f32]) -> Step;

    /// Writes the observation after the last reset or step; zeros after a step that diverged.
    ///
    /// # Panics
    /// The slices are shorter than [`TaskSpec`] says.
    fn observe(&self, proprioception: &mut [f32], task: &mut [f32]);

    /// Draws the camera image after the last reset or step: [`TaskSpec::image`] bytes, rows from the top, red, green, blue.
    /// The image is black after a step that diverged. A task without images does nothing.
    ///
    /// # Errors
    /// [`Error::Graphics`]: there is no OpenGL.
    fn draw(&mut self, image: &mut [u8]) -> Result<(), Error>;

    /// The start of the current episode.
    fn episode(&self) -> Episode;

    /// From now on records what [`take_gradients`](Self::take_gradients) needs, about 20 kB a step. Ball-catch
    /// does not.
    ///
    /// # Errors
    /// [`Error::NoDerivative`]: this body has none.
    fn record_gradients(&mut self) -> Result<(), Error> {
        Ok(())
    }

    /// For each control step since the last call, oldest first: the derivative of the rewards of that step and the later ones
    /// with respect to the action; 0 for a step that diverged. Steps before [`record_gradients`](Self::record_gradients) have none.
    fn take_gradients(&mut self) -> Vec<[f32; 56]> {
        Vec::new()
    }

    /// Replaces `errors` by the differences between the bodies' positions and the reference's, m, world: the root's first,
    /// then those of the bodies that tracking compares. Empty in a task without a reference, and after a divergence. Only
    /// evaluations ask for it.
    fn position_errors(&self, errors: &mut Vec<[f64; 3]>) {
        errors.clear();
    }

    /// What the current episode has achieved so far. The task defines it; evaluations ask for it at the episode's end.
    fn achievement(&self) -> Achievement;

    /// Writes the servo action: the action whose servos aim at the pose of the next reference frame. It is a baseline.
    /// In a task without a reference the servos aim at the current pose.
    fn servo_action(&self, action: &mut [f32]);
}

impl<E: Environment + ?Sized> Environment for Box<E> {
    fn reset(&mut self) {
        (**self).reset();
    }

    fn reset_to(&mut self, clip: usize, start: usize) -> Result<(), Error> {
        (**self).reset_to(clip, start)
    }

    fn step(&mut self, action: &[f32]) -> Step {
        (**self).step(action)
    }

    fn observe(&self, proprioception: &mut [f32], task: &mut [f32]) {
        (**self).observe(proprioception, task);
    }

    fn draw(&mut self, image: &mut [u8]) -> Result<(), Error> {
        (**self).draw(image)
    }

    fn episode(&self) -> Episode {
        (**self).episode()
    }

    fn record_gradients(&mut self) -> Result<(), Error> {
        (**self).record_gradients()
    }

    fn take_gradients(&mut self) -> Vec<[f32; 56]> {
        (**self).take_gradients()
    }

    fn position_errors(&self, errors: &mut Vec<[f64; 3]>) {
        (**self).position_errors(errors);
    }

    fn achievement(&self) -> Achievement {
        (**self).achievement()
    }

    fn servo_action(&self, action: &mut [f32]) {
        (**self).servo_action(action);
    }
}

/// An environment that is a MuJoCo simulation. Comparisons, benchmarks and rendering need more of it than acting does.
pub trait Simulated: Environment {
    /// One control step with the control in double precision; see [`Environment::step`].
    ///
    /// A caller may step after the episode's end; the physics continues. After a divergence every step reports a divergence
    /// until the next reset.
    fn step_control(&mut self, control: &[f64; 56]) -> Step;

    /// All random numbers from now on are those of `seed`. The episodes that later resets begin depend on it alone.
    fn reseed(&mut self, seed: u64);

    /// The compiled model. Other simulations may share it.
    fn model(&self) -> Arc<MjModel>;

    /// The simulation.
    fn simulation(&self) -> &Simulation;

    /// The simulation, for drawing: MuJoCo computes some values when it draws.
    fn simulation_mut(&mut self) -> &mut Simulation;

    /// What a picture shows besides the simulation.
    fn scenery(&self) -> Scenery;
}

/// What a picture shows besides the simulation. Only the task knows it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scenery {
    /// The reference's generalised coordinates: position (m, world) and quaternion of the root, joints (rad).
    pub reference: Option<Vec<f64>>,
    /// Position of the target on the floor: x and y, m.
    pub target: Option<[f64; 2]>,
}

impl Scenery {
    /// Moves the target's mark to the target. MuJoCo moves it back in its next step. The mark has no contacts and no sensor
    /// reads it, so this does not change the physics.
    pub(crate) fn mark_target(&self, site: Option<usize>, simulation: &mut Simulation) {
        let mark = site.and_then(|site| simulation.site_xpos_mut().get_mut(site));
        if let (Some(mark), Some([x, y])) = (mark, self.target) {
            *mark = [x, y, 0.0];
        }
    }
}

/// An action in double precision; NaN for an action of the wrong length.
pub(crate) fn control(action: &[f32]) -> [f64; 56] {
    <&[f32; 56]>::try_from(action).map_or([f64::NAN; 56], |action| action.map(f64::from))
}

/// The result of one control step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// The reward's terms with their weights, in the order of the task's names. Their sum is the reward.
    pub reward_terms: [f64; MAX_REWARD_TERMS],
    /// 0 when the episode ended in failure, else 1.
    pub discount: f64,
    /// Whether the episode ended, and why.
    pub outcome: Outcome,
    /// Height of the head above the floor's plane, m; 0 after a divergence. Only people use it, no learner does.
    pub head_height: f64,
}

impl Step {
    /// The result of a step that diverged.
    pub(crate) const DIVERGED: Self =
        Self { reward_terms: [0.0; MAX_REWARD_TERMS], discount: 0.0, outcome: Outcome::Diverged, head_height: 0.0 };

    /// The reward: the sum of its terms.
    pub fn reward(&self) -> f64 {
        self.reward_terms.iter().sum()
    }
}

/// The state of an episode after a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The episode continues.
    Running,
    /// The humanoid failed; in tracking the termination error is above the threshold. Discount 0.
    Terminated,
    /// The clip or the time limit ended the episode. Discount 1: later rewards still count.
    Truncated,
    /// MuJoCo gave a warning, or a number is not finite. Reward 0, discount 0.
    Diverged,
}

/// The start of an episode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Episode {
    /// Index of the clip.
    pub clip: usize,
    /// The start frame, counted from the clip's first frame.
    pub start: usize,
    /// Control steps from the start to the clip's end: the longest possible episode without a time limit.
    pub steps_left: usize,
    /// The place of the task among the tasks of [`TaskSpec`].
    pub task: usize,
}
