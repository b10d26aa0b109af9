//! The derivative of a task's reward with respect to the actions, through the simulation.
//!
//! For every control step t it gives Σ_k δ^k ∂R_{t+k} / ∂a_t, the sum over the coming steps of the same episode up to the end
//! of the unroll, with later actions held fixed. The task says what R is. It is computed backwards over recorded steps (an
//! adjoint), at a fraction of the cost of the simulation.
//!
//! # What is exact and what is not
//! ∂R/∂q and ∂R/∂v are exact. The dynamics are approximated (D): the inertia, the contacts and their state are those at the
//! start of the control step. The torque limits, and the derivatives of gravity, of Coriolis forces and of a contact's place
//! are left out. MuJoCo's own derivative by finite differences has them, but where contacts start and end it is up to fifty
//! times as large as elsewhere, and of no use for learning.

use mujoco_rs::mujoco_c::{mju_cholFactor, mju_cholSolve};
use mujoco_rs::prelude::*;

use crate::humanoid::walker::{ROOT_VELOCITIES, Walker};
use crate::physics::Data;

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

/// The parts of the model that no step changes.
#[derive(Clone, Debug)]
struct Constants {
    /// Length of a physics step, s, and physics steps in a control step.
    timestep: f64,
    substeps: usize,
    /// Of each velocity: damping, and stiffness of the joint and of its servo.
    damping: [f64; VELOCITIES],
    stiffness: [f64; VELOCITIES],
    /// Of each servo: torque for a filter state of 1, and the share of the control that the filter takes in a physics step.
    gain: [f64; ACTIONS],
    share: f64,
}

/// Limit of the factorisation's pivots (D). The matrix is positive definite, so it is never reached.
const SMALLEST_PIVOT: f64 = 1e-10;

/// A control step: the dynamics at its start, and the derivative of its reward.
#[derive(Debug)]
struct Linearisation {
    /// Cholesky factor of M + h·damping + Jᵀ D J, `[62, 62]`; empty for a step that diverged.
    factor: Vec<f64>,
    /// J, the active constraints, `[n, 62]`.
    constraints: Vec<f64>,
    /// D times stiffness and D times damping of each of them.
    forces: Vec<[f64; 2]>,
    control: [f64; ACTIONS],
    /// Of R after the step.
    reward: RewardDerivative,
    /// Whether the episode ended with the step.
    ended: bool,
}

impl Default for Linearisation {
    fn default() -> Self {
        Self {
            factor: Vec::new(),
            constraints: Vec::new(),
            forces: Vec::new(),
            control: [0.0; ACTIONS],
            reward: RewardDerivative::ZERO,
            ended: false,
        }
    }
}

/// Records control steps, and computes the derivative when asked.
#[derive(Debug)]
pub(crate) struct GradientTape {
    constants: Constants,
    /// δ.
    decay: f64,
    steps: Vec<Linearisation>,
}

impl GradientTape {
    /// `None` for the V2019 body, whose servos have no filters, and for a model with other bodies that move.
    pub(crate) fn new(model: &MjModel, substeps: usize, decay: f64) -> Option<Self> {
        // The arrays of columns that `begin_step` reads exist only with sparse constraints.
        if model.na() != ACTIONS as i64 || model.nv() != VELOCITIES as i64 || !model.is_sparse() {
            return None;
        }
        let timestep = model.opt().timestep;
        let (mut damping, mut stiffness) = ([0.0; VELOCITIES], [0.0; VELOCITIES]);
        damping.copy_from_slice(&model.dof_damping()[..VELOCITIES]);
        for (index, place) in stiffness.iter_mut().enumerate().skip(ROOT_VELOCITIES) {
            *place = model.jnt_stiffness()[model.dof_jntid()[index] as usize];
        }
        let mut gain = [0.0; ACTIONS];
        for (servo, joint) in Walker::servo_joints().into_iter().enumerate() {
            gain[servo] = model.actuator_gainprm()[servo][0];
            stiffness[ROOT_VELOCITIES + joint] -= model.actuator_biasprm()[servo][1];
        }
        let share = timestep / model.actuator_dynprm()[0][0];
        let constants = Constants { timestep, substeps, damping, stiffness, gain, share };
        Some(Self { constants, decay, steps: Vec::new() })
    }

    /// Before a control step. The simulation has just computed everything that follows from its state.
    #[allow(unsafe_code)]
    pub(crate) fn begin_step(&mut self, data: &Data, control: &[f64; ACTIONS]) {
        if self.steps.len() >= LONGEST {
            self.steps.clear();
        }
        let mut factor = vec![0.0; VELOCITIES * VELOCITIES];
        // The matrix has this size, so this cannot fail.
        let _ = data.full_m(&mut factor);
        for (index, damping) in self.constants.damping.iter().enumerate() {
            factor[index * (VELOCITIES + 1)] += self.constants.timestep * damping;
        }
        let (mut constraints, mut forces) = (Vec::new(), Vec::new());
        // SAFETY: MuJoCo wrote these arrays in the forward pass that ended the last control step or the reset, and the
        // constraints are sparse (see `new`).
        let (states, impedances, weights, counts, starts, columns) = unsafe {
            let (counts, starts) = (data.efc_j_rownnz(), data.efc_j_rowadr());
            (data.efc_state(), data.efc_kbip(), data.efc_d(), counts, starts, data.efc_j_colind())
        };
        for (row, state) in states.iter().enumerate() {
            let [stiffness, damping, impedance, _] = impedances[row];
            // A contact that slides resists only in its normal direction, the one with a stiffness.
            let active = match state {
                MjtConstraintState::mjCNSTRSTATE_QUADRATIC => true,
                MjtConstraintState::mjCNSTRSTATE_CONE => stiffness != 0.0,
                _ => false,
            };
            if !active {
                continue;
            }
            let start = constraints.len();
            constraints.resize(start + VELOCITIES, 0.0);
            let (weight, dense) = (weights[row], &mut constraints[start..]);
            let place = starts[row] as usize..starts[row] as usize + counts[row] as usize;
            let entries = columns[place.clone()].iter().map(|column| *column as usize).zip(&data.efc_j()[place]);
            for (column, value) in entries.clone() {
                dense[column] = *value;
            }
            for (column, value) in entries {
                let scaled = weight * value;
                for (place, other) in factor[column * VELOCITIES..][..VELOCITIES].iter_mut().zip(dense.iter()) {
                    *place += scaled * other;
                }
            }
            forces.push([weight * stiffness * impedance, weight * damping]);
        }
        // SAFETY: `factor` has n × n numbers for n = VELOCITIES.
        unsafe { mju_cholFactor(factor.as_mut_ptr(), VELOCITIES as i32, SMALLEST_PIVOT) };
        self.steps.push(Linearisation { factor, constraints, forces, control: *control, ..Linearisation::default() });
    }

    /// After the control step, with the derivative of its reward.
    pub(crate) fn end_step(&mut self, reward: RewardDerivative, ended: bool) {
        let Some(step) = self.steps.last_mut() else { return };
        (step.reward, step.ended) = (reward, ended);
    }

    /// A control step that diverged has no derivative. `began` says whether it was recorded.
    pub(crate) fn diverge(&mut self, began: bool) {
        if began {
            self.steps.pop();
        }
        self.steps.push(Linearisation { ended: true, ..Linearisation::default() });
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
            if step.factor.is_empty() {
                continue;
            }
            add(&mut adjoint.position, &step.reward.position);
            add(&mut adjoint.velocity, &step.reward.velocity);
            let mut control = adjoint.step_back(&self.constants, step);
            for (derivative, action) in control.iter_mut().zip(step.control) {
                // The simulator clips an action beyond ±1, so moving it further out changes nothing.
                if action.abs() >= 1.0 && *derivative * action > 0.0 {
                    *derivative = 0.0;
                }
            }
            // A simulation that is about to diverge can give any number.
            if control.iter().all(|value| value.abs() < LARGEST) {
                *gradient = control.map(|value| value as f32);
            } else {
                adjoint = Adjoint::default();
            }
        }
        self.steps.clear();
        gradients
    }
}

/// A derivative with an entry above this is left out (D). Usual entries are below 1.
const LARGEST: f64 = 1e3;
/// A tape that nobody reads is emptied after this many steps: the longest unroll.
const LONGEST: usize = 4096;

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

    /// From after a control step to before it; returns the derivative with respect to the control.
    ///
    /// A physics step is, with H the factorised matrix: f' = f + s (u − f); v' = v + h H⁻¹ (gain f − stiffness q −
    /// damping v − Jᵀ D (stiffness_c J q + damping_c J v) + …); q' = q + h v'.
    #[allow(unsafe_code)]
    fn step_back(&mut self, constants: &Constants, step: &Linearisation) -> [f64; ACTIONS] {
        let Constants { timestep, substeps, damping, stiffness, gain, share } = constants;
        let mut control = [0.0; ACTIONS];
        let mut scaled = [0.0; VELOCITIES];
        let mut force = [0.0; VELOCITIES];
        for _ in 0..*substeps {
            for ((velocity, position), scaled) in self.velocity.iter_mut().zip(&self.position).zip(&mut scaled) {
                *velocity += timestep * position;
                *scaled = timestep * *velocity;
            }
            // SAFETY: the factor has n × n numbers and the vectors have n, for n = VELOCITIES.
            unsafe {
                mju_cholSolve(force.as_mut_ptr(), step.factor.as_ptr(), scaled.as_ptr(), VELOCITIES as i32);
            }
            for (servo, joint) in Walker::servo_joints().into_iter().enumerate() {
                let filter = &mut self.filter[servo];
                control[servo] += share * *filter;
                *filter = *filter * (1.0 - share) + gain[servo] * force[ROOT_VELOCITIES + joint];
            }
            for index in 0..VELOCITIES {
                self.velocity[index] -= damping[index] * force[index];
                self.position[index] -= stiffness[index] * force[index];
            }
            for (row, [of_position, of_velocity]) in
                step.constraints.as_chunks::<VELOCITIES>().0.iter().zip(&step.forces)
            {
                let along: f64 = row.iter().zip(&force).map(|(a, b)| a * b).sum();
                for (index, value) in row.iter().enumerate() {
                    self.velocity[index] -= of_velocity * along * value;
                    self.position[index] -= of_position * along * value;
                }
            }
        }
        control
    }
}

fn add(sum: &mut [f64; VELOCITIES], other: &[f64; VELOCITIES]) {
    for (sum, other) in sum.iter_mut().zip(other) {
        *sum += other;
    }
}
