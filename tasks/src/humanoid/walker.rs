//! The places of the humanoid's parts in MuJoCo's arrays.

use std::ops::Range;

use comic_clips::{ACTUATOR_JOINTS, ACTUATORS, WalkerModel};
use mujoco_rs::prelude::*;

use super::names::{END_EFFECTORS, PREFIX};
use crate::error::Error;
use crate::physics::Simulation;

/// Number of coordinates of the root before the joints: position and quaternion.
pub(crate) const ROOT_COORDINATES: usize = 7;
/// Number of velocities of the root before the joints.
pub(crate) const ROOT_VELOCITIES: usize = 6;

/// Indices into the arrays of a compiled model.
#[derive(Debug)]
pub(crate) struct Walker {
    /// Which body this is.
    pub(crate) model: WalkerModel,
    /// Body `walker/`. Its subtree is the whole humanoid.
    pub(crate) frame: usize,
    /// Body `root`.
    pub(crate) root: usize,
    /// The tracking bodies: all of the humanoid but the root.
    pub(crate) tracked: Range<usize>,
    /// Bodies rradius, lradius, rfoot, lfoot, head.
    pub(crate) appendages: [usize; 5],
    /// Ranges of `sensordata`.
    pub(crate) velocimeter: Range<usize>,
    pub(crate) gyro: Range<usize>,
    pub(crate) accelerometer: Range<usize>,
    pub(crate) touch: Range<usize>,
    pub(crate) torque: Range<usize>,
    pub(crate) end_effectors: Range<usize>,
    /// Number of filter states: one per servo in V2020, none in V2019.
    pub(crate) activations: usize,
}

impl Walker {
    pub(crate) fn new(kind: WalkerModel, model: &MjModel) -> Result<Self, Error> {
        let body = |name: &str| {
            let full = format!("{PREFIX}{name}");
            model.name_to_id(MjtObjBase::mjOBJ_BODY, &full).ok_or_else(|| lost(&format!("body `{full}`")))
        };
        let root = body("root")?;
        let [a, b, c, d] = END_EFFECTORS;
        let sensors = |first: &str, last: &str| sensor_range(model, first, last);
        let walker = Self {
            model: kind,
            frame: body("")?,
            root,
            tracked: root + 1..root + 1 + kind.bodies(),
            appendages: [body(a)?, body(b)?, body(c)?, body(d)?, body("head")?],
            velocimeter: sensors("sensor_root_veloc", "sensor_root_veloc")?,
            gyro: sensors("sensor_root_gyro", "sensor_root_gyro")?,
            accelerometer: sensors("sensor_root_accel", "sensor_root_accel")?,
            touch: sensors("sensor_touch_lhand", "sensor_touch_lfoot")?,
            torque: sensors("sensor_torque_lhumerus", "sensor_torque_rhumerus")?,
            end_effectors: sensors("rradius_end_effector", "lfoot_end_effector")?,
            activations: usize::try_from(model.na()).unwrap_or(0),
        };
        walker.check(model)?;
        Ok(walker)
    }

    /// Height of the head, m (`head_height` of `walkers/legacy_base.py`).
    pub(crate) fn head_height(&self, data: &Simulation) -> f64 {
        let [.., head] = self.appendages;
        data.xpos()[head][2]
    }

    /// Checks that the compiled model has the joints and servos in the constant order of this workspace.
    fn check(&self, model: &MjModel) -> Result<(), Error> {
        if model.body_pos().len() < self.tracked.end {
            return Err(lost("some of the humanoid's bodies"));
        }
        for (servo, joint) in ACTUATORS.iter().zip(ACTUATOR_JOINTS) {
            let name = format!("{PREFIX}{servo}");
            let id = model.name_to_id(MjtObjBase::mjOBJ_JOINT, &name).ok_or_else(|| lost(&name))?;
            let driven = model.name_to_id(MjtObjBase::mjOBJ_ACTUATOR, &name).ok_or_else(|| lost(&name))?;
            let coordinate = usize::try_from(model.jnt_qposadr()[id]).ok();
            if coordinate != Some(ROOT_COORDINATES + joint) || ACTUATORS[driven] != *servo {
                return Err(lost(&format!("joint `{name}` at its place")));
            }
        }
        Ok(())
    }

    /// The joint of each servo, counted from the first joint after the root's coordinates or velocities.
    pub(crate) fn servo_joints() -> [usize; 56] {
        ACTUATOR_JOINTS
    }
}

fn sensor_range(model: &MjModel, first: &str, last: &str) -> Result<Range<usize>, Error> {
    let range = |name: &str| {
        let full = format!("{PREFIX}{name}");
        let id = model.name_to_id(MjtObjBase::mjOBJ_SENSOR, &full)?;
        let start = usize::try_from(model.sensor_adr()[id]).ok()?;
        let length = usize::try_from(model.sensor_dim()[id]).ok()?;
        Some(start..start + length)
    };
    let (start, end) = (range(first), range(last));
    match (start, end) {
        (Some(start), Some(end)) => Ok(start.start..end.end),
        _ => Err(lost(&format!("sensors `{first}` … `{last}`"))),
    }
}

fn lost(what: &str) -> Error {
    Error::Model { doing: "finding the humanoid's parts", reason: format!("the model lacks {what}") }
}
