//! One simulation of the tracking task.

use std::sync::Arc;

use comic_clips::spatial::subtract;
use comic_clips::{JOINT_RANGES, pose_to_action};
use comic_experiment::{TaskSpec, Tracking};
use mujoco_rs::prelude::MjModel;
use rand::SeedableRng;
use rand_distr::{Distribution as _, StandardNormal};
use rand_pcg::Pcg64;

use super::failures::Failures;
use super::gradient::differentiate;
use super::observation::{Observation, View};
use super::reference::Reference;
use super::reward;
use super::task::TrackingTask;
use crate::achievement::Achievement;
use crate::build_task::{BuildTask, Context};
use crate::environment::{ClipStarts, Environment, Episode, Outcome, Scenery, Simulated, Step, Task, control};
use crate::error::Error;
use crate::gradient::GradientTape;
use crate::humanoid::observation::Body;
use crate::humanoid::walker::ROOT_COORDINATES;
use crate::physics::{Data, Simulation, is_healthy};

/// Standard deviations of the noise of a start, at `start_noise` 1 (D): joint angles, rad; the root's velocity, m/s; angular
/// velocities of root and joints, rad/s.
const START_JOINTS: f64 = 0.1;
const START_VELOCITY: f64 = 0.3;
const START_ANGULAR_VELOCITY: f64 = 0.5;

impl BuildTask for Tracking {
    fn build(&self, context: &Context<'_>) -> Result<Arc<dyn Task>, Error> {
        let mut task = TrackingTask::new(self, context.catalogue)?;
        task.spec.action = context.experiment.action_size();
        Ok(Arc::new(task))
    }
}

impl Task for TrackingTask {
    fn spec(&self) -> &TaskSpec {
        &self.spec
    }

    fn starts(&self) -> &[ClipStarts] {
        self.starts.clips()
    }

    /// The time between two frames, which is the same for all clips.
    fn control_timestep(&self) -> f64 {
        self.models.control_timestep()
    }

    fn environment(self: Arc<Self>, seed: u64) -> Result<Box<dyn Simulated>, Error> {
        Ok(Box::new(TrackingEnvironment::new(self, seed)))
    }
}

impl TrackingTask {
    /// A new environment after its first reset. `seed` decides all its random numbers.
    pub fn tracking_environment(self: &Arc<Self>, seed: u64) -> TrackingEnvironment {
        TrackingEnvironment::new(Arc::clone(self), seed)
    }
}

/// An environment of a [`TrackingTask`]. It has its own simulation state and random numbers.
#[derive(Debug)]
pub struct TrackingEnvironment {
    task: Arc<TrackingTask>,
    data: Data,
    random: Pcg64,
    clip: usize,
    /// The episode's start frame and the current frame, counted from the sub-range's first frame.
    start: usize,
    frame: usize,
    /// Coordinates of the root and the joints one control step ago.
    previous: [f64; 63],
    error: f64,
    /// Whether the episode lasted to the clip's end, or to the time limit.
    lasted: bool,
    diverged: bool,
    /// Where episodes of training failed, if starts are drawn by failures.
    failures: Option<Failures>,
    /// The episode is one of training, and is not over.
    training: bool,
    /// Records steps for the derivative of the reward, if somebody wants it.
    tape: Option<GradientTape>,
}

impl TrackingEnvironment {
    fn new(task: Arc<TrackingTask>, seed: u64) -> Self {
        let data = task.models.data();
        let random = Pcg64::seed_from_u64(seed);
        let failures = task.failures.clone();
        let mut environment = Self {
            task,
            data,
            random,
            clip: 0,
            start: 0,
            frame: 0,
            previous: [0.0; 63],
            error: 0.0,
            lasted: false,
            diverged: false,
            failures,
            training: false,
            tape: None,
        };
        environment.reset();
        environment
    }

    /// dm_control's whole observation dictionary, in its order, in double precision; for comparisons.
    pub fn dictionary(&self) -> Vec<(&'static str, Vec<f64>)> {
        let (view, steps) = (self.view(), self.task.config.reference_steps.len());
        let value = |one: Observation| {
            let mut value = vec![0.0; one.size(&self.task.walker, steps)];
            one.write(&view, &mut value);
            (one.name(), value)
        };
        Observation::all().map(value).collect()
    }

    /// The current frame of the reference, counted from the first frame of the clip's range.
    pub fn frame(&self) -> usize {
        self.frame
    }

    /// The termination error ε after the last reset or step.
    pub fn termination_error(&self) -> f64 {
        self.error
    }

    /// The generalised positions and velocities of a start of training.
    fn draw_state(&mut self, clip: usize, frame: usize) -> ([f64; 63], [f64; 62]) {
        let (task, random) = (&self.task, &mut self.random);
        let (mut qpos, mut qvel) = (task.references[clip].qpos(frame), task.references[clip].qvel(frame));
        let noise = task.config.start_noise;
        if noise > 0.0 {
            let mut normal = |deviation: f64| {
                let draw: f64 = StandardNormal.sample(random);
                noise * deviation * draw
            };
            for (joint, [low, high]) in qpos[ROOT_COORDINATES..].iter_mut().zip(JOINT_RANGES) {
                *joint = (*joint + normal(START_JOINTS)).clamp(low, high);
            }
            for (index, velocity) in qvel.iter_mut().enumerate() {
                *velocity += normal(if index < 3 { START_VELOCITY } else { START_ANGULAR_VELOCITY });
            }
        }
        (qpos, qvel)
    }

    fn place(&mut self, clip: usize, frame: usize, [qpos, qvel]: [&[f64]; 2]) {
        if let Some(tape) = &mut self.tape {
            tape.end_episode();
        }
        let Self { task, data, .. } = self;
        let reference = &task.references[clip];
        let preset = task.config.preset_actuators.then(|| pose_to_action(reference.joints(frame)));
        let activation = preset.as_ref().map(<[f64; 56]>::as_slice).filter(|_| task.walker.activations == 56);
        task.models.place(data, qpos, qvel, activation);
        self.error = reward::termination_error(task.config.termination_error, &task.walker, data, reference, frame);
        self.previous.copy_from_slice(data.qpos());
        (self.clip, self.start, self.frame) = (clip, frame, frame);
        (self.lasted, self.diverged, self.training) = (false, false, false);
    }

    /// Counts an episode of training that is over. Later steps and evaluations count for nothing.
    fn end_episode(&mut self, failed: bool) {
        let first = self.reference().first;
        if let (Some(failures), true) = (&mut self.failures, std::mem::take(&mut self.training)) {
            failures.record(self.clip, first + self.start..first + self.frame + 1, failed);
        }
    }

    /// `began` says whether the step was recorded.
    fn diverge(&mut self, began: bool) -> Step {
        self.diverged = true;
        self.end_episode(true);
        if let Some(tape) = &mut self.tape {
            tape.diverge(began);
        }
        Step::DIVERGED
    }

    fn reference(&self) -> &Reference {
        &self.task.references[self.clip]
    }

    fn view(&self) -> View<'_> {
        View {
            body: Body { walker: &self.task.walker, data: &self.data },
            reference: self.reference(),
            steps: &self.task.config.reference_steps,
            previous: &self.previous,
            clip: self.clip,
            start: self.start,
            frame: self.frame,
        }
    }
}

impl Environment for TrackingEnvironment {
    fn reset(&mut self) {
        // A caller's own time limit may have ended the episode. Then it has not failed.
        if self.frame > self.start {
            self.end_episode(false);
        }
        let (clip, start) = match &self.failures {
            Some(failures) => failures.draw(&self.task.starts, &mut self.random),
            None => self.task.starts.draw(&mut self.random),
        };
        let first = self.task.references[clip].first;
        let frame = start.saturating_sub(first);
        let (qpos, qvel) = self.draw_state(clip, frame);
        self.place(clip, frame, [&qpos, &qvel]);
        self.training = true;
    }

    fn reset_to(&mut self, clip: usize, start: usize) -> Result<(), Error> {
        let (first, frames) = self
            .task
            .references
            .get(clip)
            .map_or((0, 0), |reference| (reference.first, reference.last_step(self.task.look_ahead)));
        match start.checked_sub(first) {
            Some(frame) if frame < frames => {
                let reference = &self.task.references[clip];
                let (qpos, qvel) = (reference.qpos(frame), reference.qvel(frame));
                self.place(clip, frame, [&qpos, &qvel]);
                Ok(())
            }
            _ => Err(Error::Start { clip, start, first, frames }),
        }
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
        let view = self.view();
        view.body.write_proprioception(proprioception);
        let (mut rest, steps) = (task, self.task.config.reference_steps.len());
        for one in &self.task.observations {
            let (place, after) = rest.split_at_mut(one.size(&self.task.walker, steps));
            one.write(&view, place);
            rest = after;
        }
    }

    fn draw(&mut self, _: &mut [u8]) -> Result<(), Error> {
        Ok(())
    }

    fn episode(&self) -> Episode {
        let reference = self.reference();
        let steps_left = reference.last_step(self.task.look_ahead).saturating_sub(self.start);
        Episode { clip: self.clip, start: reference.first + self.start, steps_left, task: 0 }
    }

    fn record_gradients(&mut self) -> Result<(), Error> {
        let TrackingTask { models, config, .. } = self.task.as_ref();
        self.tape = Some(GradientTape::new(&models.shared(), config.gradient.decay)?);
        Ok(())
    }

    fn take_gradients(&mut self) -> Vec<[f32; 56]> {
        self.tape.as_mut().map_or_else(Vec::new, GradientTape::take)
    }

    fn position_errors(&self, errors: &mut Vec<[f64; 3]>) {
        errors.clear();
        if self.diverged {
            return;
        }
        let (data, reference) = (&self.data, self.reference());
        let root = std::array::from_fn(|axis| data.qpos()[axis]);
        errors.push(subtract(root, *reference.position(self.frame)));
        let targets = reference.body_positions(self.frame).as_chunks::<3>().0;
        let bodies = &data.xpos()[self.task.walker.tracked.clone()];
        errors.extend(bodies.iter().zip(targets).map(|(body, target)| subtract(*body, *target)));
    }

    fn achievement(&self) -> Achievement {
        Achievement::new(self.lasted && !self.diverged)
    }

    fn servo_action(&self, action: &mut [f32]) {
        let target = pose_to_action(self.reference().joints(self.frame + 1));
        for (place, value) in action.iter_mut().zip(target) {
            *place = value as f32;
        }
    }
}

impl Simulated for TrackingEnvironment {
    /// References stay at the clip's last frame when a caller steps after the clip's end.
    fn step_control(&mut self, control: &[f64; 56]) -> Step {
        if self.diverged || !control.iter().all(|value| value.is_finite()) {
            return self.diverge(false);
        }
        self.previous.copy_from_slice(self.data.qpos());
        match &mut self.tape {
            None => self.task.models.step(&mut self.data, control),
            Some(tape) => {
                tape.begin_step(control);
                self.task.models.step_and(&mut self.data, control, |data| tape.record(data));
            }
        }
        self.frame += 1;
        if !is_healthy(&self.data) {
            return self.diverge(true);
        }
        let Self { task, data, frame, tape, .. } = self;
        let (reference, config) = (&task.references[self.clip], &task.config);
        self.error = reward::termination_error(config.termination_error, &task.walker, data, reference, *frame);
        let reward_terms =
            reward::terms(&task.walker, data, reference, *frame, self.error, config.termination_threshold);
        let outcome = if self.error > config.termination_threshold {
            Outcome::Terminated
        } else if *frame >= reference.last_step(task.look_ahead) || data.time() >= config.time_limit {
            Outcome::Truncated
        } else {
            Outcome::Running
        };
        self.lasted = outcome == Outcome::Truncated;
        if let Some(tape) = tape {
            let reward = differentiate(&task.walker, data, reference, *frame, self.error, config);
            tape.end_step(reward, outcome != Outcome::Running);
        }
        let discount = if outcome == Outcome::Terminated { 0.0 } else { 1.0 };
        let step = Step { reward_terms, discount, outcome, head_height: task.walker.head_height(data) };
        if outcome != Outcome::Running {
            self.end_episode(outcome == Outcome::Terminated);
        }
        step
    }

    fn reseed(&mut self, seed: u64) {
        self.random = Pcg64::seed_from_u64(seed);
        self.failures = self.task.failures.clone();
    }

    fn model(&self) -> Arc<MjModel> {
        self.task.models.shared()
    }

    fn simulation(&self) -> &Simulation {
        &self.data
    }

    fn simulation_mut(&mut self) -> &mut Simulation {
        &mut self.data
    }

    fn scenery(&self) -> Scenery {
        Scenery { reference: Some(self.reference().qpos(self.frame).to_vec()), target: None }
    }
}
