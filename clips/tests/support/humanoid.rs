//! Recordings of the humanoid itself.

use std::f64::consts::FRAC_PI_2;

use comic_clips::retarget::{Recorded, RecordedBone, RecordedPose, Role, Roles};
use comic_clips::spatial::{
    IDENTITY, Quaternion, Vector, about, aligned, conjugate, multiply, normalize, rotated, scale, subtract,
};
use comic_clips::{Catalogue, Clip, Features, JOINTS, Motion};
use comic_experiment::ClipSource;

/// The bodies after the root, in the order of [`Features`].
#[rustfmt::skip]
pub(crate) const BODIES: [&str; 31] = [
    "lhipjoint", "lfemur", "ltibia", "lfoot", "ltoes", "rhipjoint", "rfemur", "rtibia", "rfoot", "rtoes", "lowerback",
    "upperback", "thorax", "lowerneck", "upperneck", "head", "face", "lclavicle", "lhumerus", "lradius", "lwrist",
    "lhand", "lfingers", "lthumb", "rclavicle", "rhumerus", "rradius", "rwrist", "rhand", "rfingers", "rthumb",
];

/// The bones of the recordings: body, parent, role.
#[rustfmt::skip]
pub(crate) const BONES: [(&str, &str, Role); 24] = [
    ("root", "", Role::Pelvis),
    ("lfemur", "root", Role::LeftThigh), ("ltibia", "lfemur", Role::LeftShin), ("lfoot", "ltibia", Role::LeftFoot),
    ("ltoes", "lfoot", Role::LeftToes),
    ("rfemur", "root", Role::RightThigh), ("rtibia", "rfemur", Role::RightShin), ("rfoot", "rtibia", Role::RightFoot),
    ("rtoes", "rfoot", Role::RightToes),
    ("lowerback", "root", Role::Spine), ("upperback", "lowerback", Role::Chest), ("thorax", "upperback", Role::UpperChest),
    ("lowerneck", "thorax", Role::Neck), ("upperneck", "lowerneck", Role::UpperNeck), ("head", "upperneck", Role::Head),
    ("lclavicle", "thorax", Role::LeftClavicle), ("lhumerus", "lclavicle", Role::LeftUpperArm),
    ("lradius", "lhumerus", Role::LeftForearm), ("lhand", "lradius", Role::LeftHand),
    ("rclavicle", "thorax", Role::RightClavicle), ("rhumerus", "rclavicle", Role::RightUpperArm),
    ("rradius", "rhumerus", Role::RightForearm), ("rhand", "rradius", Role::RightHand),
    ("rfingers", "rhand", Role::RightFingers),
];

pub(crate) fn load(name: &str) -> Clip {
    Catalogue::open(&[ClipSource::whole(format!("builtin:{name}"))]).unwrap().load(0).unwrap()
}

fn joint(name: &str) -> usize {
    JOINTS.iter().position(|joint| *joint == name).unwrap()
}

/// Places (m) and orientations of bodies in the world: the root, then those of [`BODIES`]. One entry per frame.
pub(crate) fn bodies(motion: &Motion) -> Vec<Vec<(Vector, Quaternion)>> {
    let features = Features::of(motion);
    let frames = motion.position.iter().zip(&motion.quaternion).enumerate();
    frames
        .map(|(step, (place, turn))| {
            let (places, _) = features.body_positions[93 * step..93 * (step + 1)].as_chunks::<3>();
            let (turns, _) = features.body_quaternions[124 * step..124 * (step + 1)].as_chunks::<4>();
            std::iter::once((*place, *turn)).chain(places.iter().copied().zip(turns.iter().copied())).collect()
        })
        .collect()
}

fn body(name: &str) -> usize {
    if name == "root" { 0 } else { 1 + BODIES.iter().position(|body| *body == name).unwrap() }
}

/// Standing upright as a T with level soles.
fn rest() -> Vec<(Vector, Quaternion)> {
    let mut joints = [0.0; 56];
    for (name, degrees) in [("lfemurrz", -20.0), ("rfemurrz", 20.0), ("lfootrx", -10.3), ("rfootrx", -10.3)] {
        joints[joint(name)] = f64::to_radians(degrees);
    }
    let motion = Motion {
        position: vec![[0.0; 3]],
        quaternion: vec![about(0, FRAC_PI_2)],
        joints: vec![joints],
        ..Motion::default()
    };
    bodies(&motion).remove(0)
}

/// How a recording differs from the clip that it is made of.
#[derive(Clone, Copy)]
pub(crate) struct Style {
    /// Units of length per m.
    pub(crate) units: f64,
    /// From the clip's world to the file's.
    pub(crate) axes: Quaternion,
    /// Frames per second.
    pub(crate) rate: f64,
    /// Whether the frames of the bones are turned at random, so that the rest pose is no person.
    pub(crate) random: bool,
}

impl Style {
    pub(crate) const PLAIN: Self = Self { units: 1.0, axes: IDENTITY, rate: 1.0 / 0.03, random: false };

    pub(crate) fn y_up() -> Quaternion {
        about(0, -FRAC_PI_2)
    }
}

/// A rotation for each bone, always the same.
fn random_turn(bone: usize) -> Quaternion {
    let part = |k: usize| ((bone * 4 + k) as f64 * 12.9898).sin();
    normalize([part(0), part(1), part(2), part(3)])
}

/// The clip as a recording on the humanoid's own skeleton.
pub(crate) fn record(clip: &Clip, style: Style) -> (Recorded, Roles) {
    let motion = &clip.motion;
    let steps = clip.steps();
    let frames = ((steps - 1) as f64 * 0.03 * style.rate + 1e-9).floor() as usize + 1;
    let mut sampled = Motion::default();
    for frame in 0..frames {
        let at = frame as f64 / style.rate / 0.03;
        let step = (at.floor() as usize).min(steps - 1);
        let (next, share) = ((step + 1).min(steps - 1), at - step as f64);
        let mix = |a: f64, b: f64| (1.0 - share) * a + share * b;
        sampled.position.push(std::array::from_fn(|i| mix(motion.position[step][i], motion.position[next][i])));
        let near = aligned(motion.quaternion[next], &motion.quaternion[step]);
        sampled.quaternion.push(normalize(std::array::from_fn(|i| mix(motion.quaternion[step][i], near[i]))));
        sampled.joints.push(std::array::from_fn(|i| mix(motion.joints[step][i], motion.joints[next][i])));
    }
    let rest = rest();
    // The orientation of each bone's frame in its body's.
    let frame = |bone: usize| match style.random {
        true => random_turn(bone),
        false => multiply(conjugate(rest[body(BONES[bone].0)].1), conjugate(style.axes)),
    };
    let parent = |bone: usize| BONES.iter().position(|(name, ..)| *name == BONES[bone].1);
    let world = |pose: &[(Vector, Quaternion)], bone: usize| {
        let (place, turn) = pose[body(BONES[bone].0)];
        (scale(style.units, rotated(style.axes, place)), multiply(multiply(style.axes, turn), frame(bone)))
    };
    let poses = bodies(&sampled);
    let bones = (0..BONES.len()).map(|bone| {
        let offset = parent(bone).map(|parent| {
            let ((outer, turn), (own, _)) = (world(&poses[0], parent), world(&poses[0], bone));
            rotated(conjugate(turn), subtract(own, outer))
        });
        RecordedBone { name: BONES[bone].0.into(), parent: parent(bone), offset: offset.unwrap_or_default(), end: None }
    });
    let frames = poses.iter().map(|pose| {
        let rotation = |bone: usize| {
            let (_, own) = world(pose, bone);
            parent(bone).map_or(own, |parent| multiply(conjugate(world(pose, parent).1), own))
        };
        RecordedPose { position: world(pose, 0).0, rotations: (0..BONES.len()).map(rotation).collect() }
    });
    let recorded = Recorded {
        path: "walk.bvh".into(),
        rest_in_world: true,
        bones: bones.collect(),
        frame_seconds: 1.0 / style.rate,
        frames: frames.collect(),
    };
    let mut roles = Roles::new();
    for (bone, (_, _, role)) in BONES.iter().enumerate() {
        roles.set(*role, bone);
    }
    (recorded, roles)
}
