//! Left and right exchanged.

use super::{check, clamped, named, origin, replace_joints, smooth};
use crate::body::{Frames, body};
use crate::clip::{Clip, Features, Motion};
use crate::error::Error;
use crate::humanoid::JOINTS;
use crate::import::arms;
use crate::spatial::{IDENTITY, norm, subtract};

/// The joints of left leg, right leg, left arm and right arm begin here in [`JOINTS`].
const LEFT_LEG: usize = 0;
const RIGHT_LEG: usize = 7;
const LEFT_ARM: usize = 32;
const RIGHT_ARM: usize = 44;
/// Hinges of a leg, and of an arm with its hand.
const LEG: usize = 7;
const ARM: usize = 12;

/// The bodies at the wrists.
const WRISTS: [usize; 2] = [body("lwrist"), body("rwrist")];

/// What the ranges of the joints changed in a mirrored motion. All numbers are 0 for a motion whose arms fit.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Fit {
    /// Number of frames with a changed joint.
    pub frames: usize,
    /// Mean absolute change of an angle, over all frames and joints, degrees.
    pub mean_degrees: f64,
    /// Largest change of an angle, degrees.
    pub worst_degrees: f64,
    /// Mean distance of the wrists from where the mirror image has them, over all frames and both arms, m.
    pub wrists: f64,
}

/// The mirror image of a clip, `NAME_mirror`: left and right are exchanged by a reflection of the world in the plane x
/// = 0.
///
/// Positions become (−x, y, z), quaternions (w, x, −y, −z), and angular velocities, in the root frame, (x, −y, −z). The
/// joints of both sides are exchanged, and angles about y and z change their sign. Legs are the exact mirror image. Four
/// bodies of the spine are not exactly above the one that carries them, and each adds twice its sideways offset: thorax
/// and arms are at most 2.6 mm away from their mirror image, the neck 11 mm, the head 13 mm, and the centre of mass 2.8
/// mm. The left foot's geoms are no exact mirror image of the right one's either: soles can be 2 mm lower.
///
/// The ranges are symmetric except that of `rhumerusrz`, which has the left arm's range. Where an arm leaves its ranges
/// it is fitted as in [`import`](crate::import): elbow and wrist stay as near as possible to their places. The changes
/// are smoothed over five frames, since the nearest arm may jump. Velocities are mirrored as well; only those of fitted
/// joints change, by the differences of the change.
///
/// # Errors
/// [`Error::WrongModel`] for another body than V2020; [`Error::Edit`] for fewer than two frames, numbers that are not
/// finite, and a name that is too long.
pub fn mirror(clip: &Clip) -> Result<(Clip, Fit), Error> {
    check(clip)?;
    let name = named(format!("{}_mirror", clip.name), &[clip])?;
    let Motion { position, quaternion, joints, velocity, angular_velocity, joints_velocity } = &clip.motion;
    let mut motion = Motion {
        position: position.iter().map(|[x, y, z]| [-x, *y, *z]).collect(),
        quaternion: quaternion.iter().map(|[w, x, y, z]| [*w, *x, -y, -z]).collect(),
        joints: joints.iter().map(exchanged).collect(),
        velocity: velocity.iter().map(|[x, y, z]| [-x, *y, *z]).collect(),
        angular_velocity: angular_velocity.iter().map(|[x, y, z]| [*x, -y, -z]).collect(),
        joints_velocity: joints_velocity.iter().map(exchanged).collect(),
    };
    let fitted = fitted(&motion.joints);
    let fit = Fit::of(&motion.joints, &fitted);
    replace_joints(&mut motion, fitted, clip.dt);
    let features = Some(Features::of(&motion));
    let made_from = Some(format!("mirror {}", origin(clip)));
    Ok((Clip { name, made_from, model: clip.model, dt: clip.dt, motion, features }, fit))
}

/// Mirrored angles, or velocities.
fn exchanged(joints: &[f64; 56]) -> [f64; 56] {
    std::array::from_fn(|joint| {
        let value = joints[partner(joint)];
        if JOINTS[joint].ends_with("rx") { value } else { -value }
    })
}

/// The same joint of the other side; a joint of the spine is its own partner.
fn partner(joint: usize) -> usize {
    match joint {
        LEFT_LEG..RIGHT_LEG => joint + LEG,
        RIGHT_LEG.. if joint < RIGHT_LEG + LEG => joint - LEG,
        LEFT_ARM..RIGHT_ARM => joint + ARM,
        RIGHT_ARM.. if joint < RIGHT_ARM + ARM => joint - ARM,
        _ => joint,
    }
}

/// The angles within the ranges whose elbows and wrists are nearest. Each frame is fitted on its own, and the changes
/// are smoothed in time, since the nearest arm may jump.
fn fitted(free: &[[f64; 56]]) -> Vec<[f64; 56]> {
    let changes: Vec<[f64; 56]> = free
        .iter()
        .map(|free| {
            let mut joints = std::array::from_fn(|joint| clamped(free[joint], joint));
            if joints[LEFT_ARM..] != free[LEFT_ARM..] {
                arms::fit(free, &mut joints, arms::REGULARISATION);
            }
            std::array::from_fn(|joint| joints[joint] - free[joint])
        })
        .collect();
    let changed = |(free, change): (&[f64; 56], [f64; 56])| {
        std::array::from_fn(|joint| clamped(free[joint] + change[joint], joint))
    };
    free.iter().zip(smooth(&changes)).map(changed).collect()
}

impl Fit {
    fn of(free: &[[f64; 56]], fitted: &[[f64; 56]]) -> Self {
        let mut fit = Self::default();
        for (free, fitted) in free.iter().zip(fitted).filter(|(free, fitted)| free != fitted) {
            fit.frames += 1;
            for (free, fitted) in free.iter().zip(fitted) {
                let degrees = (fitted - free).abs().to_degrees();
                fit.mean_degrees += degrees;
                fit.worst_degrees = fit.worst_degrees.max(degrees);
            }
            let [before, after] = [free, fitted].map(|joints| Frames::of(&[0.0; 3], &IDENTITY, joints));
            fit.wrists +=
                WRISTS.map(|wrist| norm(&subtract(before.position[wrist], after.position[wrist]))).iter().sum::<f64>();
        }
        let frames = free.len().max(1) as f64;
        fit.mean_degrees /= frames * JOINTS.len() as f64;
        fit.wrists /= frames * WRISTS.len() as f64;
        fit
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_joint_of_a_side_has_its_partner() {
        for (joint, name) in JOINTS.iter().enumerate() {
            let other = JOINTS[partner(joint)];
            let spine = ["back", "neck", "thorax", "head"].iter().any(|part| name.contains(part));
            if spine {
                assert_eq!(other, *name);
            } else {
                assert_eq!(other[1..], name[1..]);
                assert_ne!(other, *name);
            }
        }
    }
}
