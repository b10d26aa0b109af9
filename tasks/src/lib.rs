//! The humanoid and the tasks it is trained on: observation, reward, termination. Knows neither libtorch nor the wire.
//!
//! # Layout
//! - [`Task`] is what all environments of a process share, [`Environment`] one simulation of it, and [`build`] makes the
//!   one that an experiment names. An actor's hot path knows no more.
//! - [`TrackingTask`] follows clips. Every other task is one file of rules (how an episode begins, what a step pays, when
//!   it fails) that one environment plays: go-to-target, gaps, walls, get-up, ball catching.
//! - [`film`] draws an environment for people, [`vision`] for the humanoid itself.
//! - [`humanoid`] builds the compiled model from dm_control's XML; [`floor`] is the same physics without a task, the
//!   yardstick of the benchmarks; [`comparison`] replays recorded episodes of dm_control's tasks.
//!
//! Tracking, go-to-target and the corridors are dm_control's: the state of the simulation is equal bit for bit,
//! observations and rewards to 1e-12 (`tests/parity`).

mod arenas;
mod assets;
mod ball_catch;
pub mod comparison;
mod corridor;
mod environment;
mod error;
mod features;
pub mod film;
pub mod floor;
mod gaps;
mod get_up;
mod ghost;
mod go_to_target;
pub mod humanoid;
mod joint;
mod observation;
mod physics;
mod quaternion;
mod reference;
mod reward;
mod rules;
mod silence;
mod stage;
mod start;
mod starts;
mod tracking;
#[cfg(feature = "viewer")]
pub mod viewer;
pub mod vision;
mod walker;
mod walls;

use std::fmt::Debug;
use std::sync::Arc;

use comic_clips::Catalogue;
use comic_experiment::{Experiment, TaskName, TaskSpec};
use mujoco_rs::prelude::MjModel;
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

use ball_catch::BallCatchRules;
use corridor::CorridorRules;
use get_up::GetUpRules;
use go_to_target::GoToTargetRules;
use joint::JointTask;
use rules::RuledTask;
use start::Poses;

pub use environment::TrackingEnvironment;
pub use error::Error;
pub use ghost::Ghost;
pub use physics::Simulation;
pub use starts::ClipStarts;
pub use tracking::TrackingTask;

/// The most reward terms a task has.
pub const MAX_REWARD_TERMS: usize = 5;

/// What all environments of a task share. Immutable.
pub trait Task: Debug + Send + Sync {
    /// Sizes and names, as networks, wire and learner know the task.
    fn spec(&self) -> &TaskSpec;

    /// Where episodes can start: frames of clips, or, for a task without clips, numbered draws.
    fn starts(&self) -> &[ClipStarts];

    /// Seconds of a control step.
    fn control_timestep(&self) -> f64;

    /// An environment, already reset; `seed` decides all its draws.
    ///
    /// # Errors
    /// When its arena cannot be built.
    fn environment(self: Arc<Self>, seed: u64) -> Result<Box<dyn Simulated>, Error>;
}

/// The task of an experiment, or its tasks. Tracking follows the catalogue's clips, the others may start in their poses.
///
/// # Errors
/// [`Error`]: clips that are missing or unusable, dm_control's XML missing.
pub fn build(experiment: &Experiment, catalogue: &Catalogue) -> Result<Arc<dyn Task>, Error> {
    if experiment.joint.is_empty() {
        return build_one(experiment, experiment.task, catalogue);
    }
    let names = catalogue.entries().iter().map(|entry| entry.name.clone()).collect();
    let spec = TaskSpec::new(experiment, names).map_err(tracking::unknown)?;
    let tasks = experiment.tasks().into_iter();
    let tasks = tasks.map(|(task, probability)| Ok((build_one(experiment, task, catalogue)?, probability)));
    Ok(Arc::new(JointTask::new(spec, tasks.collect::<Result<_, Error>>()?)))
}

fn build_one(experiment: &Experiment, task: TaskName, catalogue: &Catalogue) -> Result<Arc<dyn Task>, Error> {
    let spec = || {
        let names = catalogue.entries().iter().map(|entry| entry.name.clone()).collect();
        TaskSpec::of_task(experiment, task, names).map_err(tracking::unknown)
    };
    let poses = |kind| Poses::new(kind, catalogue);
    Ok(match task {
        TaskName::Tracking => Arc::new(TrackingTask::new(&experiment.tracking, catalogue)?),
        TaskName::GoToTarget => {
            let config = &experiment.go_to_target;
            Arc::new(RuledTask::new(GoToTargetRules::new(config, poses(config.start_pose)?)?, spec()?))
        }
        TaskName::Gaps => {
            let (config, obstacles) = (&experiment.gaps.corridor, experiment.gaps.clone());
            Arc::new(RuledTask::new(CorridorRules::new(config, poses(config.start_pose)?, obstacles), spec()?))
        }
        TaskName::Walls => {
            let (config, obstacles) = (&experiment.walls.corridor, experiment.walls.clone());
            Arc::new(RuledTask::new(CorridorRules::new(config, poses(config.start_pose)?, obstacles), spec()?))
        }
        TaskName::GetUp => Arc::new(RuledTask::new(GetUpRules::new(&experiment.get_up, catalogue)?, spec()?)),
        TaskName::BallCatch => {
            let config = &experiment.ball_catch;
            let mut random = Pcg64::seed_from_u64(experiment.seed);
            let rules = BallCatchRules::new(config, poses(config.start_pose)?, &mut random)?;
            Arc::new(RuledTask::new(rules, spec()?))
        }
    })
}

/// One environment of any task, as a policy meets it.
pub trait Environment: Debug + Send {
    /// Draws a start and begins an episode there; its first observation is ready.
    fn reset(&mut self);

    /// Begins an episode at one of the task's [starts](Task::starts): for tracking at that frame of the clip, counted
    /// from the clip's own first; for other tasks at the episode that is drawn from that number.
    ///
    /// # Errors
    /// [`Error::Start`] when there is no such start.
    fn reset_to(&mut self, clip: usize, start: usize) -> Result<(), Error>;

    /// One control step. `action` is in control order, −1 … 1 per joint's range; values beyond are clipped by MuJoCo.
    /// A value that is not finite, or an action of another length, diverges.
    fn step(&mut self, action: &[f32]) -> Step;

    /// Writes the observation after the last reset or step; zeros when that step diverged.
    ///
    /// # Panics
    /// When the slices are shorter than [`TaskSpec`] says.
    fn observe(&self, proprioception: &mut [f32], task: &mut [f32]);

    /// Draws what the humanoid sees after the last reset or step: [`vision::IMAGE_BYTES`] bytes, rows from the top, red,
    /// green, blue; black when that step diverged. A task without sight leaves the image, which is empty, alone.
    ///
    /// # Errors
    /// [`Error::Graphics`] when there is nothing to draw with.
    fn draw(&mut self, image: &mut [u8]) -> Result<(), Error>;

    /// Where the current episode began.
    fn episode(&self) -> Episode;

    /// The action whose servos aim at the pose of the next reference frame: a demonstration, and a baseline. In a task
    /// without reference it aims at the pose that is.
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

    fn servo_action(&self, action: &mut [f32]) {
        (**self).servo_action(action);
    }
}

/// An environment that is a MuJoCo simulation: what is needed beside acting, to compare, to measure and to look.
pub trait Simulated: Environment {
    /// One control step with the control in full precision; see [`Environment::step`].
    ///
    /// Nothing keeps a caller from stepping on after the episode's end: the physics goes on. After a divergence every
    /// step reports it again until the next reset.
    fn step_control(&mut self, control: &[f64; 56]) -> Step;

    /// The compiled model, which other simulations may share.
    fn model(&self) -> Arc<MjModel>;

    /// The simulation itself, to look at.
    fn simulation(&self) -> &Simulation;

    /// The simulation, to be drawn: MuJoCo fills in what its pictures need as it goes.
    fn simulation_mut(&mut self) -> &mut Simulation;

    /// What a picture shows beside the simulation.
    fn scenery(&self) -> Scenery;
}

/// What a task knows and its simulation does not, to be drawn.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scenery {
    /// The reference's generalised coordinates: the root's position (m, world) and quaternion, joints (rad).
    pub reference: Option<Vec<f64>>,
    /// Where the target lies on the floor: x and y, m.
    pub target: Option<[f64; 2]>,
}

impl Scenery {
    /// Moves the target's mark to where the target is. MuJoCo moves it back at its next step; nothing touches it and
    /// no sensor reads it, so the physics does not notice.
    pub(crate) fn mark_target(&self, site: Option<usize>, simulation: &mut Simulation) {
        let mark = site.and_then(|site| simulation.site_xpos_mut().get_mut(site));
        if let (Some(mark), Some([x, y])) = (mark, self.target) {
            *mark = [x, y, 0.0];
        }
    }
}

/// An action in full precision; of another length it is no action, and not finite.
pub(crate) fn control(action: &[f32]) -> [f64; 56] {
    <&[f32; 56]>::try_from(action).map_or([f64::NAN; 56], |action| action.map(f64::from))
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
    /// Height of the head above the floor's plane, m; 0 where the simulation diverged. For people to see: no learner needs it.
    pub head_height: f64,
}

impl Step {
    /// What a simulation gives that has diverged.
    pub(crate) const DIVERGED: Self =
        Self { reward_terms: [0.0; MAX_REWARD_TERMS], discount: 0.0, outcome: Outcome::Diverged, head_height: 0.0 };

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
    /// The task's place among the spec's tasks.
    pub task: usize,
}
