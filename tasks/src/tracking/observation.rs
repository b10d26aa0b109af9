//! The observations of dm_control's tracking task, by name (`reference_pose/tracking.py`).

use comic_clips::spatial::{axis_angle, flat_matrix, into_frame, normalize, relative, subtract};

use super::reference::Reference;
use crate::humanoid::observation::{Body, BodyObservation, Number, fill, observations};
use crate::humanoid::walker::{ROOT_COORDINATES, Walker};

/// What the tracking task's observations are computed from, after a reset or a step.
pub(super) struct View<'a> {
    pub(super) body: Body<'a>,
    pub(super) reference: &'a Reference,
    /// The reference steps: frames ahead of the current one.
    pub(super) steps: &'a [usize],
    /// Coordinates of the root and the joints one control step ago.
    pub(super) previous: &'a [f64; 63],
    /// Index of the clip.
    pub(super) clip: usize,
    /// The episode's start frame and the current frame, counted from the sub-range's first frame.
    pub(super) start: usize,
    pub(super) frame: usize,
}

/// An observation of the tracking task, in the order of dm_control's dictionary.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Observation {
    /// Props of the clip. No clip here has props.
    Props(PropsObservation),
    Body(BodyObservation),
    Reference(ReferenceObservation),
    ClipId,
    Control(ControlObservation),
}

observations! {
    /// An observation of the clip's props.
    PropsObservation {
        Position = "reference_props_pos_global",
        Quaternion = "reference_props_quat_global",
    }
}

observations! {
    /// An observation of the reference in coming frames. The comments of [`ReferenceObservation::write_frame`] say what it
    /// holds.
    ReferenceObservation {
        Joints = "walker/reference_rel_joints",
        BodiesGlobal = "walker/reference_rel_bodies_pos_global",
        BodiesQuaternions = "walker/reference_rel_bodies_quats",
        BodiesLocal = "walker/reference_rel_bodies_pos_local",
        EgoQuaternions = "walker/reference_ego_bodies_quats",
        RootQuaternion = "walker/reference_rel_root_quat",
        RootLocal = "walker/reference_rel_root_pos_local",
        Appendages = "walker/reference_appendages_pos",
    }
}

observations! {
    /// A difference to the last control step, or the time. The comments of [`ControlObservation::write`] say what it holds.
    ControlObservation {
        Velocimeter = "walker/velocimeter_control",
        Gyro = "walker/gyro_control",
        JointsVelocity = "walker/joints_vel_control",
        TimeInClip = "walker/time_in_clip",
    }
}

impl Observation {
    /// All of them, in the order of dm_control's dictionary.
    pub(super) fn all() -> impl Iterator<Item = Self> {
        let props = PropsObservation::ALL.iter().copied().map(Self::Props);
        let body = BodyObservation::ALL.iter().copied().map(Self::Body);
        let reference = ReferenceObservation::ALL.iter().copied().map(Self::Reference);
        let control = ControlObservation::ALL.iter().copied().map(Self::Control);
        props.chain(body).chain(reference).chain([Self::ClipId]).chain(control)
    }

    /// The name in dm_control's dictionary.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Props(one) => one.name(),
            Self::Body(one) => one.name(),
            Self::Reference(one) => one.name(),
            Self::ClipId => "walker/clip_id",
            Self::Control(one) => one.name(),
        }
    }

    /// The observation with this name, with or without `walker/`.
    pub(super) fn named(name: &str) -> Option<Self> {
        Self::all().find(|one| one.name() == name || one.name().strip_prefix("walker/") == Some(name))
    }

    /// How many numbers it has with `steps` reference steps.
    pub(super) fn size(self, walker: &Walker, steps: usize) -> usize {
        match self {
            Self::Props(_) => 0,
            Self::Body(one) => one.size(walker),
            Self::Reference(one) => steps * one.size(walker),
            Self::ClipId => 1,
            Self::Control(one) => one.size(),
        }
    }

    /// Writes it into `out`, which has its size. Reference observations have one block for each reference step.
    pub(super) fn write<T: Number>(self, view: &View<'_>, out: &mut [T]) {
        match self {
            Self::Props(_) => {}
            Self::Body(one) => one.write(&view.body, out),
            Self::Reference(one) => one.write(view, out),
            Self::ClipId => fill(out, [view.clip as f64]),
            Self::Control(one) => one.write(view, out),
        }
    }
}

impl ReferenceObservation {
    /// How many numbers it has in each reference step.
    fn size(self, walker: &Walker) -> usize {
        let bodies = walker.tracked.len();
        match self {
            Self::Joints => 56,
            Self::BodiesGlobal | Self::BodiesLocal => bodies * 3,
            Self::BodiesQuaternions | Self::EgoQuaternions => bodies * 4,
            Self::RootQuaternion => 4,
            Self::RootLocal => 3,
            Self::Appendages => 15,
        }
    }

    fn write<T: Number>(self, view: &View<'_>, out: &mut [T]) {
        if view.steps.is_empty() {
            return;
        }
        let width = out.len() / view.steps.len();
        for (block, step) in out.chunks_exact_mut(width.max(1)).zip(view.steps) {
            self.write_frame(view, view.frame + step, block);
        }
    }

    fn write_frame<T: Number>(self, view: &View<'_>, frame: usize, out: &mut [T]) {
        let View { body: Body { walker, data }, reference, .. } = view;
        let (positions, quaternions) = (&data.xpos()[walker.tracked.clone()], &data.xquat()[walker.tracked.clone()]);
        let rotation = &data.xmat()[walker.root];
        let root_position = || std::array::from_fn(|i| data.qpos()[i]);
        let root_quaternion = || std::array::from_fn(|i| data.qpos()[3 + i]);
        let targets = || reference.body_positions(frame).as_chunks::<3>().0.iter().zip(positions);
        match self {
            // Differences of the joint angles to the reference, rad, in control order.
            Self::Joints => {
                let (now, target) = (&data.qpos()[ROOT_COORDINATES..], reference.joints(frame));
                fill(out, Walker::servo_joints().map(|joint| target[joint] - now[joint]));
            }
            // Differences of the bodies' positions to the reference, m, in the world's and in the root's frame.
            Self::BodiesGlobal => fill(out, targets().flat_map(|(target, now)| subtract(*target, *now))),
            Self::BodiesLocal => {
                fill(out, targets().flat_map(|(target, now)| into_frame(rotation, subtract(*target, *now))));
            }
            // Rotations from the bodies to the reference's bodies, each in the body's own frame.
            Self::BodiesQuaternions => {
                let pairs = quaternions.iter().zip(reference.body_quaternions(frame));
                fill(out, pairs.flat_map(|(now, target)| relative(*now, *target)));
            }
            // The reference's bodies in the frame of the reference's root.
            Self::EgoQuaternions => {
                let root = *reference.quaternion(frame);
                fill(out, reference.body_quaternions(frame).iter().flat_map(|body| relative(root, *body)));
            }
            // The rotation from the root to the reference's root, in the root's frame.
            Self::RootQuaternion => fill(out, relative(root_quaternion(), *reference.quaternion(frame))),
            // Difference of the root's position to the reference, m, in the root's frame.
            Self::RootLocal => {
                fill(out, into_frame(rotation, subtract(*reference.position(frame), root_position())));
            }
            // The reference's appendages relative to its root, m, in the frame of the reference's root.
            Self::Appendages => fill(out, reference.appendages(frame).iter().copied()),
        }
    }
}

impl ControlObservation {
    fn size(self) -> usize {
        match self {
            Self::Velocimeter | Self::Gyro => 3,
            Self::JointsVelocity => 56,
            Self::TimeInClip => 1,
        }
    }

    fn write<T: Number>(self, view: &View<'_>, out: &mut [T]) {
        let View { body: Body { data, .. }, reference, previous, .. } = view;
        let (now, dt) = (data.qpos(), reference.dt);
        let quaternion = |qpos: &[f64]| [qpos[3], qpos[4], qpos[5], qpos[6]];
        match self {
            // m/s, in the root's frame one step ago.
            Self::Velocimeter => {
                let rotation = flat_matrix(normalize(quaternion(previous.as_slice())));
                fill(out, into_frame(&rotation, std::array::from_fn(|i| (now[i] - previous[i]) / dt)));
            }
            // rad/s, in the root's frame one step ago.
            Self::Gyro => {
                let turn = relative(quaternion(previous.as_slice()), quaternion(now));
                fill(out, axis_angle(normalize(turn)).map(|angle| angle / dt));
            }
            // rad/s, in control order.
            Self::JointsVelocity => {
                let change = |joint: usize| now[ROOT_COORDINATES + joint] - previous[ROOT_COORDINATES + joint];
                fill(out, Walker::servo_joints().map(|joint| change(joint) / dt));
            }
            // 0 at the clip's first frame, 1 at its last frame.
            Self::TimeInClip => fill(out, [(view.start as f64 * dt + data.time()) / reference.duration()]),
        }
    }
}
