//! The physics without a task: what the environments' speed is measured against.

use std::sync::Arc;

use mujoco_rs::prelude::*;

use crate::{Simulated, Simulation};

/// `6 × mj_step` + `mj_forward` per control step on an environment's own model, and nothing else.
#[derive(Debug, Default)]
pub struct RawFloor {
    data: Option<Simulation>,
}

/// A state from which the physics alone goes on.
#[derive(Clone, Debug)]
pub struct FloorState {
    model: Arc<MjModel>,
    qpos: Vec<f64>,
    qvel: Vec<f64>,
}

impl FloorState {
    /// The state of an environment.
    pub fn of(environment: &dyn Simulated) -> Self {
        let simulation = environment.simulation();
        Self { model: environment.model(), qpos: simulation.qpos().to_vec(), qvel: simulation.qvel().to_vec() }
    }
}

impl RawFloor {
    /// `mj_resetData` and the state.
    pub fn reset_to(&mut self, state: &FloorState) {
        let entered = self.data.as_mut().is_some_and(|data| data.try_swap_model(Arc::clone(&state.model)).is_ok());
        if !entered {
            self.data = None;
        }
        let data = self.data.get_or_insert_with(|| Simulation::new(Arc::clone(&state.model)));
        data.reset();
        data.qpos_mut().copy_from_slice(&state.qpos);
        data.qvel_mut().copy_from_slice(&state.qvel);
    }

    /// One control step of `substeps` physics steps; `action` as in [`Environment::step`](crate::Environment::step).
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

    /// `mj_forward`: after [`RawFloor::reset_to`], the least that a reset costs.
    pub fn forward(&mut self) {
        if let Some(data) = &mut self.data {
            data.forward();
        }
    }
}
