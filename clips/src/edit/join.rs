//! The legs of one clip with the upper body of another.

use super::{check, clamped, named, origin, replace_joints, smooth};
use crate::body::{Frames, joint};
use crate::clip::{Clip, Features, Motion};
use crate::error::Error;
use crate::spatial::{Quaternion, Vector};

/// The joints of the upper body begin here in [`JOINTS`](crate::JOINTS): thorax, necks, head and arms. Legs, lower back
/// and upper back are before.
const UPPER: usize = joint("thoraxrz");
/// The hinges that lean the trunk: forwards (about x) and sideways (about z). Each pair turns by the same angle.
const LEAN: [[usize; 2]; 2] =
    [[joint("lowerbackrx"), joint("upperbackrx")], [joint("lowerbackrz"), joint("upperbackrz")]];
/// Greatest change of each hinge of the back, rad: 8.6 degrees.
const MOST: f64 = 0.15;
/// How much a lean counts, relative to a distance of the centre of mass, m/rad. A lean of both hinges moves the centre
/// of mass of a standing body by 0.3 m/rad, so this leaves 1 % of a distance. It keeps a lying body, which no lean
/// moves horizontally, from wild angles.
const DAMPING: f64 = 0.03;
/// Steps of the Gauss-Newton method. The problem is nearly linear.
const ITERATIONS: usize = 5;
/// Change of an angle for a derivative, rad.
const DIFFERENCE: f64 = 1e-5;

/// How far the horizontal position of the centre of mass was from that in the clip of the legs, and is now.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Balance {
    /// Before the trunk was leaned: the mean and the largest distance over all frames, m.
    pub before: [f64; 2],
    /// With the lean: the same.
    pub after: [f64; 2],
    /// The largest change of a hinge of the back, degrees.
    pub lean_degrees: f64,
    /// Height of the lowest point of the body over all frames, m. Less than a few mm below 0, a hand is in the floor,
    /// or the feet of the clip of the legs are.
    pub lowest: f64,
}

/// A clip of the root and the legs of one clip and the thorax, neck, head and arms of another, `LEGS_join_UPPER`. It is
/// as long as the shorter one. The arms' angles are kept, so they are relative to the trunk of the clip of the legs.
///
/// The back is that of the legs, and it leans so that the centre of mass is horizontally where it is in the clip of the
/// legs. Lower and upper back turn by the same angles, forwards and sideways, by at most 8.6 degrees each, smoothed in
/// time. For clips of walks, runs and squats 0 to 4 cm become at most 3 mm. The angles and velocities of the legs and
/// of the upper body are the stored ones. The velocities of the back change by the differences of the lean. Nobody
/// checks whether arms touch the body or the legs.
///
/// # Errors
/// [`Error::WrongTimestep`] if the clips differ in it; [`Error::WrongModel`] for another body than V2020;
/// [`Error::Edit`] for fewer than two frames, numbers that are not finite, and names that are too long together.
pub fn join(legs: &Clip, upper: &Clip) -> Result<(Clip, Balance), Error> {
    check(legs)?;
    check(upper)?;
    if (legs.dt - upper.dt).abs() > 1e-9 {
        return Err(Error::WrongTimestep { name: upper.name.clone(), dt: upper.dt, expected: legs.dt });
    }
    let name = named(format!("{}_join_{}", legs.name, upper.name), &[legs, upper])?;
    let steps = legs.steps().min(upper.steps());
    let both = |legs: &[[f64; 56]], upper: &[[f64; 56]]| -> Vec<[f64; 56]> {
        let pairs = legs.iter().zip(upper);
        pairs.map(|(legs, upper)| std::array::from_fn(|i| if i < UPPER { legs[i] } else { upper[i] })).collect()
    };
    let mut motion = Motion {
        joints: both(&legs.motion.joints, &upper.motion.joints),
        joints_velocity: both(&legs.motion.joints_velocity, &upper.motion.joints_velocity),
        ..legs.motion.clone()
    };
    motion.position.truncate(steps);
    motion.quaternion.truncate(steps);
    motion.velocity.truncate(steps);
    motion.angular_velocity.truncate(steps);

    let poses: Vec<Pose> = (0..steps)
        .map(|frame| {
            Pose::new(
                &motion.position[frame],
                &motion.quaternion[frame],
                &motion.joints[frame],
                &legs.motion.joints[frame],
            )
        })
        .collect();
    let leans = smooth(&smooth(&poses.iter().map(Pose::lean).collect::<Vec<_>>()));
    let joints: Vec<[f64; 56]> = poses.iter().zip(&leans).map(|(pose, lean)| pose.leaned(lean)).collect();
    let balance = Balance::of(&poses, &joints);
    replace_joints(&mut motion, joints, legs.dt);
    let features = Some(Features::of(&motion));
    let made_from = Some(format!("join {} {}", origin(legs), origin(upper)));
    Ok((Clip { name, made_from, model: legs.model, dt: legs.dt, motion, features }, balance))
}

/// A frame before the trunk leans.
struct Pose {
    position: Vector,
    quaternion: Quaternion,
    joints: [f64; 56],
    /// Where the centre of mass must be, x and y, m.
    target: [f64; 2],
}

impl Pose {
    fn new(position: &Vector, quaternion: &Quaternion, joints: &[f64; 56], legs: &[f64; 56]) -> Self {
        let [x, y, _] = Frames::of(position, quaternion, legs).center_of_mass();
        Self { position: *position, quaternion: *quaternion, joints: *joints, target: [x, y] }
    }

    /// The joints with the trunk leaned forwards and sideways, within the ranges.
    fn leaned(&self, lean: &[f64; 2]) -> [f64; 56] {
        let mut joints = self.joints;
        for (hinges, angle) in LEAN.iter().zip(lean) {
            for hinge in hinges {
                joints[*hinge] = clamped(joints[*hinge] + angle, *hinge);
            }
        }
        joints
    }

    fn frames(&self, joints: &[f64; 56]) -> Frames {
        Frames::of(&self.position, &self.quaternion, joints)
    }

    /// From the target to the centre of mass, x and y, m.
    fn miss(&self, joints: &[f64; 56]) -> [f64; 2] {
        let [x, y, _] = self.frames(joints).center_of_mass();
        [x - self.target[0], y - self.target[1]]
    }

    /// The lean with the least squared distance from the target plus damping, by the Gauss-Newton method, rad.
    fn lean(&self) -> [f64; 2] {
        let mut lean = [0.0; 2];
        for _ in 0..ITERATIONS {
            let miss = self.miss(&self.leaned(&lean));
            let columns: [[f64; 2]; 2] = std::array::from_fn(|i| {
                let mut moved = lean;
                moved[i] += DIFFERENCE;
                let moved = self.miss(&self.leaned(&moved));
                [(moved[0] - miss[0]) / DIFFERENCE, (moved[1] - miss[1]) / DIFFERENCE]
            });
            let square = DAMPING * DAMPING;
            let product = |a: [f64; 2], b: [f64; 2]| a[0] * b[0] + a[1] * b[1];
            let (a, b) = (product(columns[0], columns[0]) + square, product(columns[0], columns[1]));
            let d = product(columns[1], columns[1]) + square;
            let right: [f64; 2] = std::array::from_fn(|i| product(columns[i], miss) + square * lean[i]);
            // The damping keeps the determinant above 0.
            let determinant = a * d - b * b;
            lean[0] = (lean[0] - (d * right[0] - b * right[1]) / determinant).clamp(-MOST, MOST);
            lean[1] = (lean[1] - (a * right[1] - b * right[0]) / determinant).clamp(-MOST, MOST);
        }
        lean
    }
}

impl Balance {
    fn of(poses: &[Pose], joints: &[[f64; 56]]) -> Self {
        let mut balance = Self { lowest: f64::INFINITY, ..Self::default() };
        for (pose, joints) in poses.iter().zip(joints) {
            for (distances, joints) in [(&mut balance.before, &pose.joints), (&mut balance.after, joints)] {
                let [x, y] = pose.miss(joints);
                distances[0] += x.hypot(y) / poses.len() as f64;
                distances[1] = distances[1].max(x.hypot(y));
            }
            for hinge in LEAN.as_flattened() {
                let degrees = (joints[*hinge] - pose.joints[*hinge]).abs().to_degrees();
                balance.lean_degrees = balance.lean_degrees.max(degrees);
            }
            balance.lowest = balance.lowest.min(pose.frames(joints).lowest().0);
        }
        balance
    }
}
