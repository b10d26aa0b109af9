//! Observations of the humanoid's own state, which all tasks of dm_control have (`legacy_base.py`, `cmu_humanoid.py`). One
//! definition serves the policy (f32) and the comparison with dm_control (f64).

use super::features::appendages;
use super::walker::{ROOT_COORDINATES, ROOT_VELOCITIES, Walker};
use crate::physics::Data;

/// The torque sensors' values are squashed relative to this torque (N·m, `_TORQUE_THRESHOLD`).
const TORQUE_THRESHOLD: f64 = 60.0;
/// A touch sensor reports a touch above this force (N, `_TOUCH_THRESHOLD`).
const TOUCH_THRESHOLD: f64 = 1e-3;

/// The humanoid after a reset or a step.
#[derive(Clone, Copy)]
pub(crate) struct Body<'a> {
    pub(crate) walker: &'a Walker,
    pub(crate) data: &'a Data,
}

impl Body<'_> {
    /// Writes [`PROPRIOCEPTION`] into `out`, which has its size.
    pub(crate) fn write_proprioception<T: Number>(&self, out: &mut [T]) {
        let mut rest = out;
        for one in PROPRIOCEPTION {
            let (place, after) = rest.split_at_mut(one.size(self.walker));
            one.write(self, place);
            rest = after;
        }
    }

    /// The entries of dm_control's dictionary that all its tasks have, in its order, in double precision.
    pub(crate) fn dictionary(&self) -> Vec<(&'static str, Vec<f64>)> {
        let value = |one: &BodyObservation| {
            let mut value = vec![0.0; one.size(self.walker)];
            one.write(self, &mut value);
            (one.name(), value)
        };
        BodyObservation::ALL.iter().map(value).collect()
    }
}

/// A number type of observations.
pub(crate) trait Number: Copy {
    fn of(value: f64) -> Self;
}

impl Number for f32 {
    fn of(value: f64) -> Self {
        value as f32
    }
}

impl Number for f64 {
    fn of(value: f64) -> Self {
        value
    }
}

/// Writes `values` into `out`, one after the other.
pub(crate) fn fill<T: Number>(out: &mut [T], values: impl IntoIterator<Item = f64>) {
    for (place, value) in out.iter_mut().zip(values) {
        *place = T::of(value);
    }
}

/// An enum of observations, with the list of its variants and their names in dm_control's dictionary.
macro_rules! observations {
    ($(#[$description:meta])* $kind:ident { $($variant:ident = $name:literal,)* }) => {
        $(#[$description])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(crate) enum $kind { $($variant,)* }

        impl $kind {
            /// All of them, in the order of dm_control's dictionary.
            pub(crate) const ALL: &[Self] = &[$(Self::$variant,)*];

            /// The name in dm_control's dictionary.
            pub(crate) fn name(self) -> &'static str {
                match self { $(Self::$variant => $name,)* }
            }
        }
    };
}
pub(crate) use observations;

observations! {
    /// An observation of the humanoid's own state. The comments of [`BodyObservation::write`] say what it holds.
    BodyObservation {
        ActuatorActivation = "walker/actuator_activation",
        Appendages = "walker/appendages_pos",
        BodyHeight = "walker/body_height",
        EndEffectors = "walker/end_effectors_pos",
        Joints = "walker/joints_pos",
        JointsVelocity = "walker/joints_vel",
        Accelerometer = "walker/sensors_accelerometer",
        Force = "walker/sensors_force",
        Gyro = "walker/sensors_gyro",
        Torque = "walker/sensors_torque",
        Touch = "walker/sensors_touch",
        Velocimeter = "walker/sensors_velocimeter",
        WorldZ = "walker/world_zaxis",
    }
}

/// The proprioception vector, in MoCapAct's order (205 numbers in V2020).
pub(crate) const PROPRIOCEPTION: [BodyObservation; 9] = [
    BodyObservation::Joints,
    BodyObservation::JointsVelocity,
    BodyObservation::Velocimeter,
    BodyObservation::Gyro,
    BodyObservation::EndEffectors,
    BodyObservation::WorldZ,
    BodyObservation::ActuatorActivation,
    BodyObservation::Touch,
    BodyObservation::Torque,
];

impl BodyObservation {
    /// How many numbers it has.
    pub(crate) fn size(self, walker: &Walker) -> usize {
        match self {
            Self::ActuatorActivation => walker.activations,
            Self::Appendages => 15,
            Self::BodyHeight => 1,
            Self::EndEffectors => walker.end_effectors.len(),
            Self::Joints | Self::JointsVelocity => 56,
            Self::Accelerometer => walker.accelerometer.len(),
            // The humanoid has no force sensors.
            Self::Force => 0,
            Self::Gyro => walker.gyro.len(),
            Self::Torque => walker.torque.len(),
            Self::Touch => walker.touch.len(),
            Self::Velocimeter => walker.velocimeter.len(),
            Self::WorldZ => 3,
        }
    }

    /// Writes it into `out`, which has its size.
    pub(crate) fn write<T: Number>(self, body: &Body<'_>, out: &mut [T]) {
        let Body { walker, data } = body;
        let sensors = data.sensordata();
        let (joints, velocities) = (&data.qpos()[ROOT_COORDINATES..], &data.qvel()[ROOT_VELOCITIES..]);
        let servos = Walker::servo_joints();
        match self {
            // The servos' filter states, as actions.
            Self::ActuatorActivation => fill(out, data.act().iter().copied()),
            // Positions of rradius, lradius, rfoot, lfoot, head relative to the root, m, in the root's frame.
            Self::Appendages => fill(out, appendages(walker, data)),
            // Height of the root, m.
            Self::BodyHeight => fill(out, [data.xpos()[walker.root][2]]),
            // The sensors' positions of the first four appendages, m, in the root's frame.
            Self::EndEffectors => fill(out, sensors[walker.end_effectors.clone()].iter().copied()),
            // rad and rad/s, in control order.
            Self::Joints => fill(out, servos.map(|joint| joints[joint])),
            Self::JointsVelocity => fill(out, servos.map(|joint| velocities[joint])),
            // m/s², rad/s, m/s in the root's frame.
            Self::Accelerometer => fill(out, sensors[walker.accelerometer.clone()].iter().copied()),
            Self::Gyro => fill(out, sensors[walker.gyro.clone()].iter().copied()),
            Self::Velocimeter => fill(out, sensors[walker.velocimeter.clone()].iter().copied()),
            Self::Force => {}
            // The shoulders' torques, squashed into −1 … 1.
            Self::Torque => {
                let torques = &sensors[walker.torque.clone()];
                fill(out, torques.iter().map(|torque| (2.0 * torque / TORQUE_THRESHOLD).tanh()));
            }
            // 1 where something touches, else 0.
            Self::Touch => {
                let forces = &sensors[walker.touch.clone()];
                fill(out, forces.iter().map(|force| f64::from(u8::from(*force > TOUCH_THRESHOLD))));
            }
            // The world's z axis in the root's frame.
            Self::WorldZ => fill(out, data.xmat()[walker.root][6..].iter().copied()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::PROPRIOCEPTION;

    #[test]
    fn proprioception_has_the_order_of_exported_policies() {
        let names = PROPRIOCEPTION.map(|one| one.name().strip_prefix("walker/").unwrap_or_default());
        assert_eq!(names, comic_experiment::PROPRIOCEPTION.map(|(name, _)| name));
    }
}
