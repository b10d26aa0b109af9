//! Steps MuJoCo as dm_control does.

use std::sync::Arc;

use mujoco_rs::mujoco_c::mjtDisableBit;
use mujoco_rs::prelude::*;

use crate::error::Error;

/// A simulation on a shared model.
pub type Simulation = MjData<Arc<MjModel>>;
pub(crate) type Data = Simulation;

/// Length of one physics step, s (`DEFAULT_PHYSICS_TIMESTEP` of `reference_pose/tracking.py`).
pub(crate) const PHYSICS_TIMESTEP: f64 = 0.005;

/// MuJoCo calls a larger number bad (`mjMAXVAL`).
const MAX_VALUE: f64 = 1e10;

/// The compiled model, with the servos on and with the servos off. dm_control computes an episode's first observation with
/// the servos off. All simulations share both.
#[derive(Debug)]
pub(crate) struct Models {
    active: Arc<MjModel>,
    passive: Arc<MjModel>,
    /// Physics steps in a control step.
    substeps: usize,
}

impl Models {
    pub(crate) fn new(model: MjModel, substeps: usize) -> Self {
        let mut passive = model.clone();
        passive.opt_mut().disableflags |= mjtDisableBit::mjDSBL_ACTUATION as i32;
        Self { active: Arc::new(model), passive: Arc::new(passive), substeps }
    }

    /// Length of a control step, s.
    pub(crate) fn control_timestep(&self) -> f64 {
        self.substeps as f64 * self.active.opt().timestep
    }

    /// A new simulation state. It reserves 18 MB, of which the operating system commits only the used part.
    pub(crate) fn data(&self) -> Data {
        Data::new(Arc::clone(&self.active))
    }

    /// The model with the servos on.
    pub(crate) fn shared(&self) -> Arc<MjModel> {
        Arc::clone(&self.active)
    }

    /// Moves a simulation to this model. When the memory layouts differ, it returns `false` and changes nothing.
    pub(crate) fn take_over(&self, data: &mut Data) -> bool {
        data.try_swap_model(Arc::clone(&self.active)).is_ok()
    }

    /// Sets the state and computes everything that follows from it without servo forces. The default of `activation`, the
    /// filter states, is 0.
    pub(crate) fn place(&self, data: &mut Data, qpos: &[f64], qvel: &[f64], activation: Option<&[f64]>) {
        data.reset();
        data.qpos_mut().copy_from_slice(qpos);
        data.qvel_mut().copy_from_slice(qvel);
        if let Some(activation) = activation {
            data.act_mut().copy_from_slice(activation);
        }
        // The two models differ in one option only, so this cannot fail.
        if let Ok(active) = data.try_swap_model(Arc::clone(&self.passive)) {
            data.forward();
            let _ = data.try_swap_model(active);
        }
    }

    /// One control step with a constant control. It is equal bit for bit to dm_control's loop of `mj_step2, mj_step1`, and
    /// faster than `mj_step` alone: the `mj_forward` at the end of the last control step is the first half of the first
    /// step. The accelerometer, touch and torque sensors need this `mj_forward`.
    pub(crate) fn step(&self, data: &mut Data, control: &[f64; 56]) {
        self.step_and(data, control, |_| {});
    }

    /// [`Models::step`]. It calls `record` after each physics step, when the state is new and everything else is that of the
    /// state before.
    pub(crate) fn step_and(&self, data: &mut Data, control: &[f64; 56], mut record: impl FnMut(&Data)) {
        data.ctrl_mut().copy_from_slice(control);
        data.step2();
        record(data);
        for _ in 1..self.substeps {
            data.step();
            record(data);
        }
        data.forward();
    }
}

/// Whether MuJoCo gave no warning since the simulation's last reset, and all coordinates, velocities and accelerations are
/// small enough. MuJoCo itself checks positions and velocities only before a step, so they are checked again here.
pub(crate) fn is_healthy(data: &Data) -> bool {
    let sane = |values: &[f64]| values.iter().all(|value| value.abs() < MAX_VALUE);
    data.warning().iter().all(|warning| warning.number == 0)
        && sane(data.qpos())
        && sane(data.qvel())
        && sane(data.qacc())
}

/// The number of physics steps in a control step of `dt` seconds.
pub(crate) fn substeps(clip: &str, dt: f64) -> Result<usize, Error> {
    let count = (dt / PHYSICS_TIMESTEP).round();
    if count >= 1.0 && (count * PHYSICS_TIMESTEP - dt).abs() < 1e-9 {
        return Ok(count as usize);
    }
    Err(Error::Clip {
        clip: clip.into(),
        reason: format!("dt = {dt} s is not a multiple of the physics step of {PHYSICS_TIMESTEP} s; resample the clip"),
    })
}

#[cfg(test)]
mod tests {
    use comic_clips::WalkerModel;

    use super::*;
    use crate::humanoid;

    fn upright(models: &Models, data: &mut Data, speed: f64) {
        let mut qpos = [0.0; 63];
        qpos[2] = 1.5;
        qpos[3] = 1.0;
        models.place(data, &qpos, &[speed; 62], None);
    }

    #[test]
    fn a_diverged_simulation_is_unhealthy_until_its_state_is_set_again() {
        let models = Models::new(humanoid::build(WalkerModel::Cmu2020).unwrap(), 6);
        let mut data = models.data();
        for speed in [1e5, 1e8, 1e11, f64::NAN] {
            upright(&models, &mut data, speed);
            models.step(&mut data, &[1.0; 56]);
            assert!(!is_healthy(&data), "{speed}");
            upright(&models, &mut data, 0.0);
            models.step(&mut data, &[0.0; 56]);
            assert!(is_healthy(&data));
        }
        assert!(!std::path::Path::new("MUJOCO_LOG.TXT").exists(), "MuJoCo wrote its warnings to a file");
    }

    #[test]
    fn the_faster_sequence_gives_the_numbers_of_the_plain_one() {
        let models = Models::new(humanoid::build(WalkerModel::Cmu2020).unwrap(), 6);
        let (mut fast, mut plain) = (models.data(), models.data());
        upright(&models, &mut fast, 0.1);
        upright(&models, &mut plain, 0.1);
        for step in 0..50 {
            let control = std::array::from_fn(|servo| ((step * 56 + servo) as f64).sin());
            models.step(&mut fast, &control);
            plain.ctrl_mut().copy_from_slice(&control);
            for _ in 0..6 {
                plain.step();
            }
            plain.forward();
            assert_eq!(fast.qpos(), plain.qpos());
            assert_eq!(fast.qvel(), plain.qvel());
            assert_eq!(fast.act(), plain.act());
            assert_eq!(fast.sensordata(), plain.sensordata());
        }
    }
}
