//! The interface of every task but tracking, and the environment that plays one.
//!
//! A task is one file with a type that implements [`Rules`], and a line in [`build`](crate::build).

use std::fmt::Debug;
use std::sync::Arc;

use comic_experiment::{TaskSpec, Vision};
use mujoco_rs::prelude::MjModel;
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

use crate::error::Error;
use crate::observation::Number;
use crate::physics::{Simulation, is_healthy};
use crate::stage::{CONTROL_TIMESTEP, Stage};
use crate::start::Pose;
use crate::starts::ClipStarts;
use crate::{Environment, Episode, MAX_REWARD_TERMS, Outcome, Scenery, Simulated, Step, Task, control, vision};

/// Starts of an evaluation: episode k of a task is the one that its draws from seed k give.
const EVALUATION_STARTS: usize = 64;

/// How a task begins an episode, what it pays and when it fails. Immutable and shared by all environments.
pub(crate) trait Rules: Debug + Send + Sync + 'static {
    /// What one environment of the task remembers.
    type Memory: Debug + Default + Send;

    /// A simulation in the task's arena, or in one of them.
    ///
    /// # Errors
    /// When it cannot be built.
    fn stage(&self, random: &mut Pcg64) -> Result<Stage, Error>;

    /// Draws an episode and puts everything into its first state.
    fn begin(&self, stage: &mut Stage, memory: &mut Self::Memory, random: &mut Pcg64);

    /// What the control step that has just been simulated gave.
    fn judge(&self, stage: &mut Stage, memory: &mut Self::Memory, random: &mut Pcg64) -> Verdict;

    /// Writes the task observation.
    fn observe<T: Number>(&self, stage: &Stage, memory: &Self::Memory, out: &mut [T]);

    /// Seconds an episode lasts.
    fn time_limit(&self) -> f64;

    /// Where its target lies on the floor, in a task that marks one: x and y, m.
    fn target(&self, _: &Self::Memory) -> Option<[f64; 2]> {
        None
    }

    /// How the humanoid sees.
    fn vision(&self) -> Vision {
        Vision::Off
    }
}

/// Rules that dm_control has too, so that its recordings can be replayed.
pub(crate) trait Recorded: Rules {
    /// What dm_control's dictionary has beside the body's observations.
    fn observation(&self, stage: &Stage, memory: &Self::Memory) -> Vec<(&'static str, Vec<f64>)>;

    /// What was recorded beside the observations.
    fn quantities(&self, stage: &Stage, memory: &Self::Memory) -> Vec<(&'static str, Vec<f64>)>;
}

/// What a control step gave, before the time is looked at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Verdict {
    pub(crate) reward_terms: [f64; MAX_REWARD_TERMS],
    pub(crate) failed: bool,
}

impl Verdict {
    /// One reward term.
    pub(crate) fn of(reward: f64, failed: bool) -> Self {
        let mut reward_terms = [0.0; MAX_REWARD_TERMS];
        reward_terms[0] = reward;
        Self { reward_terms, failed }
    }
}

/// A task that is played by [`Rules`].
#[derive(Debug)]
pub(crate) struct RuledTask<R> {
    rules: R,
    spec: TaskSpec,
    starts: [ClipStarts; 1],
}

impl<R: Rules> RuledTask<R> {
    pub(crate) fn new(rules: R, spec: TaskSpec) -> Self {
        let starts = [ClipStarts { clip: 0, frames: 0..EVALUATION_STARTS, probability: 1.0 }];
        Self { rules, spec, starts }
    }
}

impl<R: Rules> Task for RuledTask<R> {
    fn spec(&self) -> &TaskSpec {
        &self.spec
    }

    fn starts(&self) -> &[ClipStarts] {
        &self.starts
    }

    fn control_timestep(&self) -> f64 {
        CONTROL_TIMESTEP
    }

    fn environment(self: Arc<Self>, seed: u64) -> Result<Box<dyn Simulated>, Error> {
        Ok(Box::new(RuledEnvironment::new(self, seed)?))
    }
}

/// One simulation of a task.
#[derive(Debug)]
pub(crate) struct RuledEnvironment<R: Rules> {
    task: Arc<RuledTask<R>>,
    stage: Stage,
    memory: R::Memory,
    random: Pcg64,
    start: usize,
    /// Control steps since the last reset.
    steps: usize,
    diverged: bool,
}

impl<R: Rules> RuledEnvironment<R> {
    fn new(task: Arc<RuledTask<R>>, seed: u64) -> Result<Self, Error> {
        let mut random = Pcg64::seed_from_u64(seed);
        let stage = task.rules.stage(&mut random)?;
        let mut environment =
            Self { task, stage, memory: R::Memory::default(), random, start: 0, steps: 0, diverged: false };
        environment.reset();
        Ok(environment)
    }

    /// An environment in which an episode has just begun in this pose.
    pub(crate) fn at(rules: R, pose: &Pose, memory: R::Memory) -> Result<Self, Error> {
        let mut random = Pcg64::seed_from_u64(0);
        let mut stage = rules.stage(&mut random)?;
        stage.place(&pose.qpos, &pose.qvel);
        let task = Arc::new(RuledTask::new(rules, TaskSpec::default()));
        Ok(Self { task, stage, memory, random, start: 0, steps: 0, diverged: false })
    }

    pub(crate) fn stage(&self) -> &Stage {
        &self.stage
    }

    pub(crate) fn memory(&self) -> &R::Memory {
        &self.memory
    }

    pub(crate) fn rules(&self) -> &R {
        &self.task.rules
    }

    /// The control steps after which the time is up.
    fn most_steps(&self) -> usize {
        let steps = self.task.rules.time_limit() / CONTROL_TIMESTEP;
        // 45 s are 1500 steps, whatever the division makes of it.
        (steps - 1e-9).ceil().max(1.0) as usize
    }

    fn diverge(&mut self) -> Step {
        self.diverged = true;
        Step::DIVERGED
    }
}

impl<R: Rules> Environment for RuledEnvironment<R> {
    fn reset(&mut self) {
        (self.steps, self.diverged) = (0, false);
        self.task.rules.begin(&mut self.stage, &mut self.memory, &mut self.random);
    }

    fn reset_to(&mut self, clip: usize, start: usize) -> Result<(), Error> {
        let frames = self.task.starts[0].frames.clone();
        if clip != 0 || !frames.contains(&start) {
            return Err(Error::Start { clip, start, first: frames.start, frames: frames.len() });
        }
        self.random = Pcg64::seed_from_u64(start as u64);
        // What the last episode left behind must not decide this one.
        self.memory = R::Memory::default();
        self.start = start;
        self.reset();
        Ok(())
    }

    fn step(&mut self, action: &[f32]) -> Step {
        self.step_control(&control(action))
    }

    fn observe(&self, proprioception: &mut [f32], task: &mut [f32]) {
        if self.diverged {
            proprioception.fill(0.0);
            task.fill(0.0);
            return;
        }
        self.stage.body().write_proprioception(proprioception);
        self.task.rules.observe(&self.stage, &self.memory, task);
    }

    fn draw(&mut self, image: &mut [u8]) -> Result<(), Error> {
        if self.diverged {
            image.fill(0);
            return Ok(());
        }
        vision::draw(self.task.rules.vision(), &mut self.stage.data, image)
    }

    fn episode(&self) -> Episode {
        Episode { clip: 0, start: self.start, steps_left: self.most_steps(), task: 0 }
    }

    fn servo_action(&self, action: &mut [f32]) {
        // Hold the joints where they are.
        let joints: [f64; 56] = std::array::from_fn(|joint| self.stage.data.qpos()[7 + joint]);
        for (place, value) in action.iter_mut().zip(comic_clips::pose_to_action(&joints)) {
            *place = value as f32;
        }
    }
}

impl<R: Rules> Simulated for RuledEnvironment<R> {
    fn step_control(&mut self, control: &[f64; 56]) -> Step {
        if self.diverged || !control.iter().all(|value| value.is_finite()) {
            return self.diverge();
        }
        self.stage.step(control);
        self.steps += 1;
        if !is_healthy(&self.stage.data) {
            return self.diverge();
        }
        let Verdict { reward_terms, failed } =
            self.task.rules.judge(&mut self.stage, &mut self.memory, &mut self.random);
        let outcome = if failed {
            Outcome::Terminated
        } else if self.steps >= self.most_steps() {
            Outcome::Truncated
        } else {
            Outcome::Running
        };
        let discount = if failed { 0.0 } else { 1.0 };
        Step { reward_terms, discount, outcome, head_height: self.stage.head_height() }
    }

    fn model(&self) -> Arc<MjModel> {
        self.stage.arena.models.shared()
    }

    fn simulation(&self) -> &Simulation {
        &self.stage.data
    }

    fn simulation_mut(&mut self) -> &mut Simulation {
        &mut self.stage.data
    }

    fn scenery(&self) -> Scenery {
        Scenery { reference: None, target: self.task.rules.target(&self.memory) }
    }
}
