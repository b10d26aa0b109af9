//! The physics without a task. Benchmarks compare an environment's speed with it.

use std::sync::Arc;

use mujoco_rs::prelude::*;

use crate::environment::Simulated;
use crate::physics::Simulation;

/// A simulation of an environment's model that only steps: `6 × mj_step` and one `mj_forward` in a control step.
#[derive(Debug, Default)]
pub struct RawPhysics {
    data: Option<Simulation>,
}

/// An environment's model and state, from which [`RawPhysics`] continues.
#[derive(Clone, Debug)]
pub struct PhysicsState {
    model: Arc<MjModel>,
    qpos: Vec<f64>,
    qvel: Vec<f64>,
}

impl PhysicsState {
    /// The state of an environment.
    pub fn of(environment: &dyn Simulated) -> Self {
        let simulation = environment.simulation();
        Self { model: environment.model(), qpos: simulation.qpos().to_vec(), qvel: simulation.qvel().to_vec() }
    }
}

impl RawPhysics {
    /// Calls `mj_resetData` and sets the state.
    pub fn reset_to(&mut self, state: &PhysicsState) {
        let moved = self.data.as_mut().is_some_and(|data| data.try_swap_model(Arc::clone(&state.model)).is_ok());
        if !moved {
            self.data = None;
        }
        let data = self.data.get_or_insert_with(|| Simulation::new(Arc::clone(&state.model)));
        data.reset();
        data.qpos_mut().copy_from_slice(&state.qpos);
        data.qvel_mut().copy_from_slice(&state.qvel);
    }

    /// One control step of `substeps` physics steps; `action` is that of [`Environment::step`](crate::Environment::step).
    pub fn step(&mut self, action: &[f32], substeps: usize) {
        let Some(data) = &mut self.data else { return };
        for (place, value) in data.ctrl_mut().iter_mut().zip(action) {
            *place = f64::from(*value);
        }
        for _ in 0..substeps {
            data.step();
        }
        data.forward();
    }

    /// Calls `mj_forward`. With [`RawPhysics::reset_to`] this is the smallest possible work of a reset.
    pub fn forward(&mut self) {
        if let Some(data) = &mut self.data {
            data.forward();
        }
    }
}
