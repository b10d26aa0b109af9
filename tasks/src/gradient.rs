//! The derivative of a task's reward with respect to the actions, through the simulation.
//!
//! For every control step t it gives Σ_k δ^k ∂R_{t+k} / ∂a_t, the sum over the coming steps of the same episode up to the end
//! of the unroll, with later actions held fixed. The task says what R is. It is computed backwards over recorded physics
//! steps (an adjoint), at a fraction of the cost of the simulation. `docs/derivative.md` has the formulas, the comparison
//! with finite differences, and the relatives of this method.
//!
//! # What is exact and what is not
//! ∂R/∂q and ∂R/∂v are exact. Every third physics step is linearised with its own inertia and contacts, whose set and place are
//! held fixed (D). The torque limits, and the derivatives of gravity, of Coriolis forces and of a contact's place are left
//! out. MuJoCo's own derivative by finite differences has them, but where contacts start and end it is up to fifty times as
//! large as elsewhere, and of no use for learning.

mod constraints;
mod dynamics;
mod forces;

use comic_experiment::{LARGEST_ACTION_GRADIENT, LONGEST_UNROLL};
use mujoco_rs::prelude::MjModel;

use crate::error::Error;
use crate::humanoid::walker::{ROOT_VELOCITIES, Walker};
use crate::physics::Data;
use dynamics::{Constants, Constraint, PhysicsStep};
pub(crate) use forces::Forces;

/// Velocities of the humanoid: six of the root, and its joints.
pub(crate) const VELOCITIES: usize = 62;
/// Servos.
pub(crate) const ACTIONS: usize = 56;

/// ∂R/∂q, as velocities, and ∂R/∂v.
#[derive(Debug)]
pub(crate) struct RewardDerivative {
    pub(crate) position: [f64; VELOCITIES],
    pub(crate) velocity: [f64; VELOCITIES],
}

impl RewardDerivative {
    /// No reward.
    pub(crate) const ZERO: Self = Self { position: [0.0; VELOCITIES], velocity: [0.0; VELOCITIES] };
}

/// A control step: its physics steps, its action, and the derivative of its reward.
#[derive(Debug)]
struct ControlStep {
    /// The number of physics steps, and where the recorded ones begin.
    physics_steps: usize,
    begin: usize,
    control: [f64; ACTIONS],
    /// Of R after the step.
    reward: RewardDerivative,
    /// Whether the episode ended with the step.
    ended: bool,
}

/// Records control steps, and computes the derivative when asked.
#[derive(Debug)]
pub(crate) struct GradientTape {
    constants: Constants,
    /// δ.
    decay: f64,
    steps: Vec<ControlStep>,
    /// The physics steps of all control steps. Those from `recorded` on hold memory that is used again.
    physics: Vec<PhysicsStep>,
    recorded: usize,
}

impl GradientTape {
    /// # Errors
    /// [`Error::NoDerivative`] for the V2019 body, whose servos have no filters, and for any other model that the formulas do
    /// not describe.
    pub(crate) fn new(model: &MjModel, decay: f64) -> Result<Self, Error> {
        let constants = Constants::new(model)?;
        Ok(Self { constants, decay, steps: Vec::new(), physics: Vec::new(), recorded: 0 })
    }

    /// Before a control step.
    pub(crate) fn begin_step(&mut self, control: &[f64; ACTIONS]) {
        // Nobody reads this tape.
        if self.steps.len() >= LONGEST_UNROLL {
            self.clear();
        }
        let (begin, reward) = (self.recorded, RewardDerivative::ZERO);
        self.steps.push(ControlStep { physics_steps: 0, begin, control: *control, reward, ended: false });
    }

    /// After each physics step of the control step, of which it keeps every third. MuJoCo's arrays are then those of the state before the physics step.
    pub(crate) fn record(&mut self, data: &Data) {
        let Some(step) = self.steps.last_mut() else { return };
        if step.physics_steps.is_multiple_of(STRIDE) {
            if self.recorded == self.physics.len() {
                self.physics.push(PhysicsStep::default());
            }
            self.physics[self.recorded].read(&self.constants, data);
            self.recorded += 1;
        }
        step.physics_steps += 1;
    }

    /// After the control step, with the derivative of its reward.
    pub(crate) fn end_step(&mut self, reward: RewardDerivative, ended: bool) {
        let Some(step) = self.steps.last_mut() else { return };
        (step.reward, step.ended) = (reward, ended);
    }

    /// A control step that diverged has no derivative. `began` says whether it was recorded.
    pub(crate) fn diverge(&mut self, began: bool) {
        if began && let Some(step) = self.steps.pop() {
            self.recorded = step.begin;
        }
        self.begin_step(&[0.0; ACTIONS]);
        self.end_episode();
    }

    /// The episode ends with the last step.
    pub(crate) fn end_episode(&mut self) {
        if let Some(step) = self.steps.last_mut() {
            step.ended = true;
        }
    }

    /// The derivatives of the recorded steps, oldest first. The tape is then empty.
    pub(crate) fn take(&mut self) -> Vec<[f32; ACTIONS]> {
        let mut gradients = vec![[0.0; ACTIONS]; self.steps.len()];
        let mut adjoint = Adjoint::default();
        for (step, gradient) in self.steps.iter().zip(&mut gradients).rev() {
            adjoint = if step.ended { Adjoint::default() } else { adjoint.scaled(self.decay) };
            add(&mut adjoint.position, &step.reward.position);
            add(&mut adjoint.velocity, &step.reward.velocity);
            let mut control = [0.0; ACTIONS];
            for index in (0..step.physics_steps).rev() {
                adjoint.step_back(&self.constants, &self.physics[step.begin + index / STRIDE], &mut control);
            }
            for (derivative, action) in control.iter_mut().zip(step.control) {
                // The simulator clips an action beyond ±1, so moving it further out changes nothing.
                if action.abs() >= 1.0 && *derivative * action > 0.0 {
                    *derivative = 0.0;
                }
            }
            // A simulation that is about to diverge can give any number.
            if control.iter().all(|value| value.abs() <= f64::from(LARGEST_ACTION_GRADIENT)) {
                *gradient = control.map(|value| value as f32);
            } else {
                adjoint = Adjoint::default();
            }
        }
        self.clear();
        gradients
    }

    fn clear(&mut self) {
        self.steps.clear();
        self.recorded = 0;
    }
}

/// Physics steps that one linearisation stands for (D). With 1 an actor is 6 % slower, and cosines against finite differences
/// are higher by at most 0.011 (`docs/derivative.md`).
const STRIDE: usize = 3;

/// The derivative of the coming rewards with respect to the state: positions (as velocities), velocities, filters.
#[derive(Clone, Debug)]
struct Adjoint {
    position: [f64; VELOCITIES],
    velocity: [f64; VELOCITIES],
    filter: [f64; ACTIONS],
}

impl Default for Adjoint {
    fn default() -> Self {
        Self { position: [0.0; VELOCITIES], velocity: [0.0; VELOCITIES], filter: [0.0; ACTIONS] }
    }
}

impl Adjoint {
    fn scaled(mut self, factor: f64) -> Self {
        let Self { position, velocity, filter } = &mut self;
        for value in position.iter_mut().chain(velocity).chain(filter) {
            *value *= factor;
        }
        self
    }

    /// From after a physics step to before it; adds the derivative with respect to the control to `control`.
    ///
    /// A physics step is f' = f + s (u − f); v' = v + h H⁻¹ (gain f − stiffness q − damping v − Jᵀ D (stiffness_c J q +
    /// damping_c J v) + …); q' = q + h v'.
    fn step_back(&mut self, constants: &Constants, step: &PhysicsStep, control: &mut [f64; ACTIONS]) {
        let Constants { timestep, damping, stiffness, gain, share, .. } = constants;
        let mut force = [0.0; VELOCITIES];
        for ((velocity, position), force) in self.velocity.iter_mut().zip(&self.position).zip(&mut force) {
            *velocity += timestep * position;
            *force = timestep * *velocity;
        }
        step.solve(constants, &mut force);
        for (servo, joint) in Walker::servo_joints().into_iter().enumerate() {
            let filter = &mut self.filter[servo];
            control[servo] += share * *filter;
            *filter = *filter * (1.0 - share) + gain[servo] * force[ROOT_VELOCITIES + joint];
        }
        for index in 0..VELOCITIES {
            self.velocity[index] -= damping[index] * force[index];
            self.position[index] -= stiffness[index] * force[index];
        }
        for Constraint { entries, stiffness, damping, .. } in &step.constraints {
            let row = step.columns[entries.clone()].iter().zip(&step.values[entries.clone()]);
            let along: f64 = row.clone().map(|(column, value)| value * force[*column]).sum();
            for (column, value) in row {
                self.position[*column] -= stiffness * along * value;
                self.velocity[*column] -= damping * along * value;
            }
        }
    }
}

fn add(sum: &mut [f64; VELOCITIES], other: &[f64; VELOCITIES]) {
    for (sum, other) in sum.iter_mut().zip(other) {
        *sum += other;
    }
}

#[cfg(test)]
pub(crate) mod tests;
