//! Every observation of dm_control's tracking task, by name (env: `legacy_base.py`, `cmu_humanoid.py`,
//! `reference_pose/tracking.py`). One definition serves the policy (f32) and the comparison with dm_control (f64).

use crate::features::appendages;
use crate::physics::Data;
use crate::quaternion::{axis_angle, difference, into_frame, matrix, normalised, relative};
use crate::reference::Reference;
use crate::walker::{ROOT_COORDINATES, ROOT_VELOCITIES, Walker};

/// Torque by which the torque sensors are squashed (N·m, `_TORQUE_THRESHOLD`).
const TORQUE_THRESHOLD: f64 = 60.0;
/// Force beyond which a touch sensor reports a touch (N, `_TOUCH_THRESHOLD`).
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
            let (place, after) = rest.split_at_mut(one.size(self.walker, 0));
            one.write_body(self, place);
            rest = after;
        }
    }

    /// The part of dm_control's dictionary that all its tasks have, in its order, in full precision.
    pub(crate) fn dictionary(&self) -> Vec<(&'static str, Vec<f64>)> {
        let value = |one: Observation| {
            let mut value = vec![0.0; one.size(self.walker, 0)];
            one.write_body(self, &mut value);
            (one.name(), value)
        };
        BODY.iter().map(|one| value(*one)).collect()
    }
}

/// What the tracking task's observations are computed from, after a reset or a step.
pub(crate) struct View<'a> {
    pub(crate) body: Body<'a>,
    pub(crate) reference: &'a Reference,
    /// Which frames ahead are references.
    pub(crate) steps: &'a [usize],
    /// The root and the joints one control step ago: `qpos` as it was.
    pub(crate) previous: &'a [f64; 63],
    /// Index of the clip.
    pub(crate) clip: usize,
    /// The frame the episode started at and the current one, counted from the sub-range's first.
    pub(crate) start: usize,
    pub(crate) frame: usize,
}

/// A number type that observations are written in.
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

macro_rules! observations {
    ($($variant:ident = $name:literal,)*) => {
        /// An observation; the comments of [`Observation::write`] say what it holds.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(crate) enum Observation { $($variant,)* }

        /// All of them, in the order of dm_control's dictionary.
        pub(crate) const ALL: &[Observation] = &[$(Observation::$variant,)*];

        impl Observation {
            /// The name in dm_control's dictionary.
            pub(crate) fn name(self) -> &'static str {
                match self { $(Observation::$variant => $name,)* }
            }
        }
    };
}

observations! {
    ReferencePropsPosition = "reference_props_pos_global",
    ReferencePropsQuaternion = "reference_props_quat_global",
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
    ReferenceJoints = "walker/reference_rel_joints",
    ReferenceBodiesGlobal = "walker/reference_rel_bodies_pos_global",
    ReferenceBodiesQuaternions = "walker/reference_rel_bodies_quats",
    ReferenceBodiesLocal = "walker/reference_rel_bodies_pos_local",
    ReferenceEgoQuaternions = "walker/reference_ego_bodies_quats",
    ReferenceRootQuaternion = "walker/reference_rel_root_quat",
    ReferenceRootLocal = "walker/reference_rel_root_pos_local",
    ReferenceAppendages = "walker/reference_appendages_pos",
    ClipId = "walker/clip_id",
    VelocimeterControl = "walker/velocimeter_control",
    GyroControl = "walker/gyro_control",
    JointsVelocityControl = "walker/joints_vel_control",
    TimeInClip = "walker/time_in_clip",
}

/// The proprioception vector, in MoCapAct's order (205 numbers in V2020).
pub(crate) const PROPRIOCEPTION: [Observation; 9] = [
    Observation::Joints,
    Observation::JointsVelocity,
    Observation::Velocimeter,
    Observation::Gyro,
    Observation::EndEffectors,
    Observation::WorldZ,
    Observation::ActuatorActivation,
    Observation::Touch,
    Observation::Torque,
];

/// What the body feels, in the order of dm_control's dictionary.
const BODY: [Observation; 13] = [
    Observation::ActuatorActivation,
    Observation::Appendages,
    Observation::BodyHeight,
    Observation::EndEffectors,
    Observation::Joints,
    Observation::JointsVelocity,
    Observation::Accelerometer,
    Observation::Force,
    Observation::Gyro,
    Observation::Torque,
    Observation::Touch,
    Observation::Velocimeter,
    Observation::WorldZ,
];

impl Observation {
    /// The observation of that name, with or without `walker/`.
    pub(crate) fn named(name: &str) -> Option<Self> {
        ALL.iter().copied().find(|one| one.name() == name || one.name().strip_prefix("walker/") == Some(name))
    }

    /// How many numbers it has with `steps` reference steps.
    pub(crate) fn size(self, walker: &Walker, steps: usize) -> usize {
        use Observation as O;
        let bodies = walker.tracked.len();
        match self {
            O::ReferencePropsPosition | O::ReferencePropsQuaternion | O::Force => 0,
            O::ActuatorActivation => walker.activations,
            O::Appendages => 15,
            O::BodyHeight | O::ClipId | O::TimeInClip => 1,
            O::EndEffectors => walker.end_effectors.len(),
            O::Joints | O::JointsVelocity | O::JointsVelocityControl => 56,
            O::Accelerometer => walker.accelerometer.len(),
            O::Gyro => walker.gyro.len(),
            O::Torque => walker.torque.len(),
            O::Touch => walker.touch.len(),
            O::Velocimeter => walker.velocimeter.len(),
            O::WorldZ | O::VelocimeterControl | O::GyroControl => 3,
            O::ReferenceJoints => steps * 56,
            O::ReferenceBodiesGlobal | O::ReferenceBodiesLocal => steps * bodies * 3,
            O::ReferenceBodiesQuaternions | O::ReferenceEgoQuaternions => steps * bodies * 4,
            O::ReferenceRootQuaternion => steps * 4,
            O::ReferenceRootLocal => steps * 3,
            O::ReferenceAppendages => steps * 15,
        }
    }

    /// Writes it into `out`, which has its size. Reference observations have the reference step slowest.
    pub(crate) fn write<T: Number>(self, view: &View<'_>, out: &mut [T]) {
        use Observation as O;
        match self {
            O::ReferencePropsPosition | O::ReferencePropsQuaternion => {}
            O::ReferenceJoints
            | O::ReferenceBodiesGlobal
            | O::ReferenceBodiesQuaternions
            | O::ReferenceBodiesLocal
            | O::ReferenceEgoQuaternions
            | O::ReferenceRootQuaternion
            | O::ReferenceRootLocal
            | O::ReferenceAppendages => self.write_reference(view, out),
            O::ClipId => fill(out, [view.clip as f64]),
            O::VelocimeterControl | O::GyroControl | O::JointsVelocityControl | O::TimeInClip => {
                self.write_control(view, out);
            }
            _ => self.write_body(&view.body, out),
        }
    }

    /// What the body feels now.
    fn write_body<T: Number>(self, body: &Body<'_>, out: &mut [T]) {
        use Observation as O;
        let Body { walker, data } = body;
        let sensors = data.sensordata();
        let (joints, velocities) = (&data.qpos()[ROOT_COORDINATES..], &data.qvel()[ROOT_VELOCITIES..]);
        let servos = Walker::servo_joints();
        match self {
            // The humanoid has no force sensors.
            O::Force => {}
            // Filter states of the servos, as actions.
            O::ActuatorActivation => fill(out, data.act().iter().copied()),
            // rradius, lradius, rfoot, lfoot, head relative to the root, m, root frame.
            O::Appendages => fill(out, appendages(walker, data)),
            // Height of the root, m.
            O::BodyHeight => fill(out, [data.xpos()[walker.root][2]]),
            // The first four appendages, as sensors give them.
            O::EndEffectors => fill(out, sensors[walker.end_effectors.clone()].iter().copied()),
            // rad and rad/s, in control order.
            O::Joints => fill(out, servos.map(|joint| joints[joint])),
            O::JointsVelocity => fill(out, servos.map(|joint| velocities[joint])),
            // m/s², rad/s, m/s in the root's frame.
            O::Accelerometer => fill(out, sensors[walker.accelerometer.clone()].iter().copied()),
            O::Gyro => fill(out, sensors[walker.gyro.clone()].iter().copied()),
            O::Velocimeter => fill(out, sensors[walker.velocimeter.clone()].iter().copied()),
            // Torques at the shoulders, squashed into −1 … 1.
            O::Torque => {
                fill(out, sensors[walker.torque.clone()].iter().map(|torque| (2.0 * torque / TORQUE_THRESHOLD).tanh()));
            }
            // 1 where something touches.
            O::Touch => {
                fill(
                    out,
                    sensors[walker.touch.clone()].iter().map(|force| f64::from(u8::from(*force > TOUCH_THRESHOLD))),
                );
            }
            // The world's z axis in the root's frame.
            _ => fill(out, data.xmat()[walker.root][6..].iter().copied()),
        }
    }

    /// Where the body should be in the coming frames.
    fn write_reference<T: Number>(self, view: &View<'_>, out: &mut [T]) {
        if view.steps.is_empty() {
            return;
        }
        let width = out.len() / view.steps.len();
        for (block, step) in out.chunks_exact_mut(width.max(1)).zip(view.steps) {
            self.write_frame(view, view.frame + step, block);
        }
    }

    fn write_frame<T: Number>(self, view: &View<'_>, frame: usize, out: &mut [T]) {
        use Observation as O;
        let View { body: Body { walker, data }, reference, .. } = view;
        let (positions, quaternions) = (&data.xpos()[walker.tracked.clone()], &data.xquat()[walker.tracked.clone()]);
        let rotation = &data.xmat()[walker.root];
        let root_position = || std::array::from_fn(|i| data.qpos()[i]);
        let root_quaternion = || std::array::from_fn(|i| data.qpos()[3 + i]);
        let targets = || reference.body_positions(frame).as_chunks::<3>().0.iter().zip(positions);
        match self {
            // Joint angles still to go, rad, in control order.
            O::ReferenceJoints => {
                let (now, target) = (&data.qpos()[ROOT_COORDINATES..], reference.joints(frame));
                fill(out, Walker::servo_joints().map(|joint| target[joint] - now[joint]));
            }
            // Ways of the bodies still to go, m, in the world's and in the root's frame.
            O::ReferenceBodiesGlobal => fill(out, targets().flat_map(|(target, now)| difference(target, now))),
            O::ReferenceBodiesLocal => {
                fill(out, targets().flat_map(|(target, now)| into_frame(rotation, difference(target, now))));
            }
            // Turns of the bodies still to go, each in its own frame.
            O::ReferenceBodiesQuaternions => {
                let pairs = quaternions.iter().zip(reference.body_quaternions(frame));
                fill(out, pairs.flat_map(|(now, target)| relative(now, target)));
            }
            // The reference's bodies in the frame of the reference's root.
            O::ReferenceEgoQuaternions => {
                let root = reference.quaternion(frame);
                fill(out, reference.body_quaternions(frame).iter().flat_map(|body| relative(root, body)));
            }
            O::ReferenceRootQuaternion => fill(out, relative(&root_quaternion(), reference.quaternion(frame))),
            O::ReferenceRootLocal => {
                fill(out, into_frame(rotation, difference(reference.position(frame), &root_position())));
            }
            _ => fill(out, reference.appendages(frame).iter().copied()),
        }
    }

    /// Differences to the last control step, and the time.
    fn write_control<T: Number>(self, view: &View<'_>, out: &mut [T]) {
        use Observation as O;
        let View { body: Body { data, .. }, reference, previous, .. } = view;
        let (now, dt) = (data.qpos(), reference.dt);
        let quaternion = |qpos: &[f64]| [qpos[3], qpos[4], qpos[5], qpos[6]];
        match self {
            // m/s, in the frame the root had a step ago.
            O::VelocimeterControl => {
                let rotation = matrix(&normalised(&quaternion(previous.as_slice())));
                fill(out, into_frame(&rotation, std::array::from_fn(|i| (now[i] - previous[i]) / dt)));
            }
            // rad/s, in that frame.
            O::GyroControl => {
                let turn = relative(&quaternion(previous.as_slice()), &quaternion(now));
                fill(out, axis_angle(&normalised(&turn)).map(|angle| angle / dt));
            }
            // rad/s, in control order.
            O::JointsVelocityControl => {
                let change = |joint: usize| now[ROOT_COORDINATES + joint] - previous[ROOT_COORDINATES + joint];
                fill(out, Walker::servo_joints().map(|joint| change(joint) / dt));
            }
            // 0 at the clip's first frame, 1 at its last.
            _ => fill(out, [(view.start as f64 * dt + data.time()) / reference.duration()]),
        }
    }
}

/// Writes `values`, one after the other.
pub(crate) fn fill<T: Number>(out: &mut [T], values: impl IntoIterator<Item = f64>) {
    for (place, value) in out.iter_mut().zip(values) {
        *place = T::of(value);
    }
}

#[cfg(test)]
mod tests {
    use super::PROPRIOCEPTION;

    #[test]
    fn proprioception_is_in_the_order_that_exported_policies_name() {
        let names = PROPRIOCEPTION.map(|one| one.name().strip_prefix("walker/").unwrap_or_default());
        assert_eq!(names, comic_experiment::PROPRIOCEPTION.map(|(name, _)| name));
    }
}
