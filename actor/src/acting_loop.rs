//! The loop in which environments act: observe → forward pass → choose an action → make it a command → step → record.
//!
//! The [worker](crate::worker) and the [evaluation](crate::evaluate) share it. They differ in the `Recorder`: the worker's
//! writes unrolls, the evaluation's collects episodes.

use std::ops::ControlFlow;

use comic_proto::{Field, UnrollShape};
use comic_tasks::{Environment, Episode, MAX_REWARD_TERMS, Outcome, Step};

use crate::Error;
use crate::forward_pass::{ActingBatch, ActingRow, ForwardPass, LowLevelShape, clip_command};

/// What decides on the distribution of actions.
#[derive(Debug)]
pub enum Controller<'a, F> {
    /// A policy.
    Policy(&'a mut F),
    /// The servo action: the pose of the next reference frame.
    Servo,
    /// The zero action: every servo aims at the middle of its joint's range.
    Zero,
}

impl<F: ForwardPass> Controller<'_, F> {
    /// Writes the action distribution of every row.
    fn decide<E: Environment>(&mut self, rollouts: &[Rollout<E>], batch: &mut ActingBatch) -> Result<(), Error> {
        let write_action: fn(&Rollout<E>, &mut [f32]) = match self {
            Self::Policy(forward) => return forward.forward(batch),
            Self::Servo => Rollout::servo_action,
            Self::Zero => |_, action| action.fill(0.0),
        };
        for (index, rollout) in rollouts.iter().enumerate() {
            let mut row = batch.row(index);
            row.set_action(|mean| write_action(rollout, mean));
            // No policy acts, so there is no latent and no recurrent state.
            row.latent.fill(0.0);
            row.reset_recurrent_state();
        }
        Ok(())
    }

    /// Turns the chosen actions into commands for the simulator.
    fn actuate(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        match self {
            Self::Policy(forward) => forward.actuate(batch),
            Self::Servo | Self::Zero => {
                batch.command.copy_from_slice(&batch.action);
                Ok(())
            }
        }
    }

    /// The frozen low level that acts for a policy, if any.
    pub(crate) fn low_level(&self) -> Option<LowLevelShape> {
        match self {
            Self::Policy(forward) => forward.low_level(),
            Self::Servo | Self::Zero => None,
        }
    }
}

/// What happens around the steps of the environments. `index` is the environment's place in the loop.
pub(crate) trait Recorder<E> {
    /// Before the forward pass: the row holds the current observation without the camera image.
    ///
    /// # Errors
    /// A camera image that cannot be drawn.
    fn observe(&mut self, index: usize, rollout: &mut Rollout<E>, row: &mut ActingRow<'_>) -> Result<(), Error>;

    /// Before the forward pass: draws the noise of the row's latent.
    fn draw_latent_noise(&mut self, index: usize, row: &mut ActingRow<'_>);

    /// After the forward pass: chooses the row's action from its distribution.
    fn choose(&mut self, index: usize, rollout: &Rollout<E>, row: &mut ActingRow<'_>);

    /// With the command: moves the environment on by a step, or begins an episode. `Break` ends the iteration.
    ///
    /// # Errors
    /// Whatever ends the loop.
    fn step(
        &mut self,
        index: usize,
        rollout: &mut Rollout<E>,
        row: &mut ActingRow<'_>,
    ) -> Result<ControlFlow<()>, Error>;
}

/// E environments that act together.
#[derive(Debug)]
pub(crate) struct ActingLoop<E> {
    pub(crate) rollouts: Vec<Rollout<E>>,
    pub(crate) batch: ActingBatch,
}

impl<E: Environment> ActingLoop<E> {
    /// Environments that are in no episode yet.
    pub(crate) fn new(environments: Vec<E>, shape: &UnrollShape, low_level: Option<LowLevelShape>) -> Self {
        let batch = ActingBatch::new(environments.len(), shape, low_level);
        Self { rollouts: environments.into_iter().map(Rollout::new).collect(), batch }
    }

    /// Records every environment's current observation.
    pub(crate) fn observe(&mut self, recorder: &mut impl Recorder<E>) -> Result<(), Error> {
        for (index, rollout) in self.rollouts.iter_mut().enumerate() {
            recorder.observe(index, rollout, &mut self.batch.row(index))?;
        }
        Ok(())
    }

    /// One iteration of all environments. `Break` when the recorder ended it.
    ///
    /// # Errors
    /// A failing forward pass, or what the recorder returns.
    pub(crate) fn iterate<F: ForwardPass>(
        &mut self,
        controller: &mut Controller<'_, F>,
        recorder: &mut impl Recorder<E>,
    ) -> Result<ControlFlow<()>, Error> {
        self.observe(recorder)?;
        for index in 0..self.rollouts.len() {
            recorder.draw_latent_noise(index, &mut self.batch.row(index));
        }
        controller.decide(&self.rollouts, &mut self.batch)?;
        for (index, rollout) in self.rollouts.iter().enumerate() {
            recorder.choose(index, rollout, &mut self.batch.row(index));
        }
        controller.actuate(&mut self.batch)?;
        for (index, rollout) in self.rollouts.iter_mut().enumerate() {
            if recorder.step(index, rollout, &mut self.batch.row(index))?.is_break() {
                return Ok(ControlFlow::Break(()));
            }
        }
        Ok(ControlFlow::Continue(()))
    }
}

/// An environment and its current episode.
#[derive(Debug)]
pub(crate) struct Rollout<E> {
    pub(crate) environment: E,
    pub(crate) episode: Episode,
    /// The episode is over, and no other one has begun.
    pub(crate) ended: bool,
    /// Steps since the episode began.
    pub(crate) steps: u32,
    /// Sums of the reward terms since the episode began.
    pub(crate) returns: [f64; MAX_REWARD_TERMS],
    /// Sum of the head's heights after each step, m.
    pub(crate) head_heights: f64,
}

impl<E: Environment> Rollout<E> {
    fn new(environment: E) -> Self {
        Self {
            environment,
            episode: Episode::default(),
            ended: true,
            steps: 0,
            returns: [0.0; MAX_REWARD_TERMS],
            head_heights: 0.0,
        }
    }

    /// Begins the episode for which the environment was just reset, and writes its first observation.
    pub(crate) fn begin_episode(&mut self, row: &mut ActingRow<'_>) {
        self.episode = self.environment.episode();
        self.ended = false;
        self.steps = 0;
        self.returns = [0.0; MAX_REWARD_TERMS];
        self.head_heights = 0.0;
        row.reset_recurrent_state();
        self.write_observation(row);
    }

    /// Takes a step with the row's command, which is clipped, and writes the next observation.
    pub(crate) fn step(&mut self, row: &mut ActingRow<'_>) -> Step {
        clip_command(row.command);
        let step = self.environment.step(row.command);
        self.steps += 1;
        for (sum, term) in self.returns.iter_mut().zip(&step.reward_terms) {
            *sum += term;
        }
        self.head_heights += step.head_height;
        self.ended = step.outcome != Outcome::Running;
        let ActingRow { fields, latent, .. } = row;
        fields[Field::PreviousLatent].copy_from_slice(latent);
        self.write_observation(row);
        step
    }

    /// The pose of the next reference frame as an action, or zeros where no action follows.
    fn servo_action(&self, action: &mut [f32]) {
        if self.ended {
            action.fill(0.0);
        } else {
            self.environment.servo_action(action);
        }
    }

    fn write_observation(&self, row: &mut ActingRow<'_>) {
        let task = std::mem::take(&mut row.fields[Field::Task]);
        self.environment.observe(row.fields[Field::Proprioception], task);
        row.fields[Field::Task] = task;
        *row.task = self.episode.task;
    }
}
