//! The environment that plays the rules of any task without a reference.

use std::sync::Arc;

use comic_experiment::{CONTROL_TIMESTEP, TaskSpec};
use mujoco_rs::prelude::MjModel;
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

use super::interface::{Rules, Verdict};
use super::poses::Pose;
use super::stage::Stage;
use crate::achievement::Achievement;
use crate::environment::{ClipStarts, Environment, Episode, Outcome, Scenery, Simulated, Step, Task, control};
use crate::error::Error;
use crate::gradient::GradientTape;
use crate::physics::{Simulation, is_healthy};
use crate::rendering::vision;

/// Number of starts for an evaluation. Start k is the episode that seed k draws.
const EVALUATION_STARTS: usize = 64;

/// A task with [`Rules`].
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
    state: R::State,
    random: Pcg64,
    start: usize,
    /// Control steps since the last reset.
    steps: usize,
    /// Control steps until the time limit of this episode.
    max_steps: usize,
    /// Whether a step of this episode failed.
    failed: bool,
    diverged: bool,
    /// Records steps for the derivative of the reward, if somebody wants it.
    tape: Option<GradientTape>,
}

impl<R: Rules> RuledEnvironment<R> {
    fn new(task: Arc<RuledTask<R>>, seed: u64) -> Result<Self, Error> {
        let mut random = Pcg64::seed_from_u64(seed);
        let stage = task.rules.stage(&mut random)?;
        let state = R::State::default();
        let max_steps = steps_in(task.rules.training_time_limit());
        let mut environment = Self::of_parts(task, stage, state, random, max_steps);
        environment.reset();
        Ok(environment)
    }

    /// An environment in which an episode begins in this pose.
    pub(crate) fn at(rules: R, pose: &Pose, state: R::State) -> Result<Self, Error> {
        let mut random = Pcg64::seed_from_u64(0);
        let mut stage = rules.stage(&mut random)?;
        stage.place(&pose.qpos, &pose.qvel);
        let task = Arc::new(RuledTask::new(rules, TaskSpec::default()));
        let max_steps = steps_in(task.rules.time_limit());
        Ok(Self::of_parts(task, stage, state, random, max_steps))
    }

    fn of_parts(task: Arc<RuledTask<R>>, stage: Stage, state: R::State, random: Pcg64, max_steps: usize) -> Self {
        let (start, steps, failed, diverged, tape) = (0, 0, false, false, None);
        Self { task, stage, state, random, start, steps, max_steps, failed, diverged, tape }
    }

    /// Moves the first state to these coordinates. The velocities stay.
    pub(crate) fn begin_at(&mut self, qpos: &[f64; 63]) {
        let qvel = self.stage.data.qvel().to_vec();
        self.stage.place(qpos, &qvel);
    }

    pub(crate) fn stage(&self) -> &Stage {
        &self.stage
    }

    pub(crate) fn state(&self) -> &R::State {
        &self.state
    }

    pub(crate) fn rules(&self) -> &R {
        &self.task.rules
    }

    /// Begins an episode of at most so many seconds.
    fn begin(&mut self, time_limit: f64) {
        (self.steps, self.max_steps) = (0, steps_in(time_limit));
        (self.failed, self.diverged) = (false, false);
        if let Some(tape) = &mut self.tape {
            tape.end_episode();
        }
        self.task.rules.begin(&mut self.stage, &mut self.state, &mut self.random);
    }

    /// `began` says whether the step was recorded.
    fn diverge(&mut self, began: bool) -> Step {
        self.diverged = true;
        if let Some(tape) = &mut self.tape {
            tape.diverge(began);
        }
        Step::DIVERGED
    }
}

/// The number of control steps in so many seconds.
fn steps_in(seconds: f64) -> usize {
    // The division is not exact. 45 s must give 1500 steps.
    (seconds / CONTROL_TIMESTEP - 1e-9).ceil().max(1.0) as usize
}

impl<R: Rules> Environment for RuledEnvironment<R> {
    fn reset(&mut self) {
        self.begin(self.task.rules.training_time_limit());
    }

    fn reset_to(&mut self, clip: usize, start: usize) -> Result<(), Error> {
        let frames = self.task.starts[0].frames.clone();
        if clip != 0 || !frames.contains(&start) {
            return Err(Error::Start { clip, start, first: frames.start, frames: frames.len() });
        }
        self.reseed(start as u64);
        self.start = start;
        self.begin(self.task.rules.time_limit());
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
        self.task.rules.observe(&self.stage, &self.state, task);
    }

    fn draw(&mut self, image: &mut [u8]) -> Result<(), Error> {
        if self.diverged {
            image.fill(0);
            return Ok(());
        }
        vision::draw(self.task.rules.vision(), std::any::type_name::<R>(), &mut self.stage.data, image)
    }

    fn episode(&self) -> Episode {
        Episode { clip: 0, start: self.start, steps_left: self.max_steps, task: 0 }
    }

    fn record_gradients(&mut self) -> Result<(), Error> {
        let model = self.stage.arena.models.shared();
        let decay = self.task.rules.gradient_decay();
        self.tape = decay.map(|decay| GradientTape::new(&model, decay)).transpose()?;
        Ok(())
    }

    fn take_gradients(&mut self) -> Vec<[f32; 56]> {
        self.tape.as_mut().map_or_else(Vec::new, GradientTape::take)
    }

    fn achievement(&self) -> Achievement {
        let achievement = self.task.rules.achievement(&self.stage, &self.state, self.failed);
        if self.diverged { achievement.of_divergence() } else { achievement }
    }

    fn servo_action(&self, action: &mut [f32]) {
        // The servos hold the joints in their current positions.
        let joints: [f64; 56] = std::array::from_fn(|joint| self.stage.data.qpos()[7 + joint]);
        for (place, value) in action.iter_mut().zip(comic_clips::pose_to_action(&joints)) {
            *place = value as f32;
        }
    }
}

impl<R: Rules> Simulated for RuledEnvironment<R> {
    fn step_control(&mut self, control: &[f64; 56]) -> Step {
        if self.diverged || !control.iter().all(|value| value.is_finite()) {
            return self.diverge(false);
        }
        match &mut self.tape {
            None => self.stage.step(control),
            Some(tape) => {
                tape.begin_step(control);
                let Stage { arena, data } = &mut self.stage;
                arena.models.step_and(data, control, |data| tape.record(data));
            }
        }
        self.steps += 1;
        if !is_healthy(&self.stage.data) {
            return self.diverge(true);
        }
        let Verdict { reward_terms, failed } =
            self.task.rules.judge(&mut self.stage, &mut self.state, &mut self.random);
        self.failed |= failed;
        let outcome = if failed {
            Outcome::Terminated
        } else if self.steps >= self.max_steps {
            Outcome::Truncated
        } else {
            Outcome::Running
        };
        if let Some(tape) = &mut self.tape {
            let reward = self.task.rules.differentiate(&self.stage, &self.state);
            tape.end_step(reward, outcome != Outcome::Running);
        }
        let discount = if failed { 0.0 } else { 1.0 };
        Step { reward_terms, discount, outcome, head_height: self.stage.head_height() }
    }

    fn reseed(&mut self, seed: u64) {
        self.random = Pcg64::seed_from_u64(seed);
        // The last episode must not change the next one.
        self.state = R::State::default();
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
        Scenery { reference: None, target: self.task.rules.target(&self.state) }
    }
}
