//! The poses in which episodes of tasks without a reference begin.

use comic_clips::spatial::{about_vector, multiply, normalize, rotated};
use comic_clips::{Catalogue, WalkerModel};
use comic_experiment::StartPose;
use rand::Rng;

use crate::error::Error;
use crate::humanoid::walker::ROOT_COORDINATES;

/// Height (m) and orientation of the upright root (`cmu_humanoid.py`, `_UPRIGHT_POS_V2020`, `_UPRIGHT_QUAT`).
const UPRIGHT_HEIGHT: f64 = 1.143;
const UPRIGHT_QUATERNION: [f64; 4] = [0.859, 1.0, 1.0, 0.859];

/// Coordinates and velocities of the humanoid's root and joints.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pose {
    pub(crate) qpos: [f64; 63],
    pub(crate) qvel: [f64; 62],
}

impl Pose {
    /// The upright pose: facing +x, every joint at 0 (`initializers.UprightInitializer`).
    pub(crate) fn upright() -> Self {
        let mut qpos = [0.0; 63];
        qpos[2] = UPRIGHT_HEIGHT;
        qpos[3..7].copy_from_slice(&normalize(UPRIGHT_QUATERNION));
        Self { qpos, qvel: [0.0; 62] }
    }

    /// The root's position, m.
    pub(crate) fn position_mut(&mut self) -> &mut [f64] {
        &mut self.qpos[..3]
    }

    /// The joints' angles, rad, in the clips' order.
    pub(crate) fn joints_mut(&mut self) -> &mut [f64] {
        &mut self.qpos[ROOT_COORDINATES..]
    }

    /// The pose moved by `x` and `y` (m), as by `Entity.shift_pose`.
    pub(crate) fn moved(mut self, x: f64, y: f64) -> Self {
        self.qpos[0] += x;
        self.qpos[1] += y;
        self
    }

    /// The pose and its linear velocity, turned about the world's axis `axis` by `angle` (rad). The angular velocity
    /// does not change: it is in the root's own frame (`Entity.shift_pose` with `rotate_velocity`).
    pub(crate) fn turned(mut self, axis: [f64; 3], angle: f64) -> Self {
        let by = about_vector(axis, angle);
        let turned = normalize(multiply(by, self.quaternion()));
        self.qpos[3..7].copy_from_slice(&turned);
        let velocity = rotated(by, [self.qvel[0], self.qvel[1], self.qvel[2]]);
        self.qvel[..3].copy_from_slice(&velocity);
        self
    }

    /// Angle about the vertical between +x and the root's forward axis, its own z, rad.
    pub(crate) fn heading(&self) -> f64 {
        let [x, y, _] = rotated(self.quaternion(), [0.0, 0.0, 1.0]);
        y.atan2(x)
    }

    fn quaternion(&self) -> [f64; 4] {
        [self.qpos[3], self.qpos[4], self.qpos[5], self.qpos[6]]
    }
}

/// The poses in which a task's episodes can begin. All are at the origin and face +x.
#[derive(Debug)]
pub(crate) struct Poses(Vec<Pose>);

impl Poses {
    /// The upright pose alone.
    pub(crate) fn upright() -> Self {
        Self(vec![Pose::upright()])
    }

    /// The upright pose, or the frames of the clips.
    ///
    /// # Errors
    /// The clips cannot be read, or they are for another body.
    pub(crate) fn new(kind: StartPose, catalogue: &Catalogue) -> Result<Self, Error> {
        match kind {
            StartPose::Upright => Ok(Self::upright()),
            StartPose::Clip => Self::of_clips(catalogue, usize::MAX),
        }
    }

    /// The first `frames` frames of every clip's range.
    pub(crate) fn of_clips(catalogue: &Catalogue, frames: usize) -> Result<Self, Error> {
        let mut poses = Vec::new();
        for (index, entry) in catalogue.entries().iter().enumerate() {
            entry.check(WalkerModel::Cmu2020, entry.dt, 0, 1)?;
            let motion = catalogue.load(index)?.motion;
            for frame in entry.frames().take(frames) {
                let mut pose = Pose::upright();
                pose.qpos[..3].copy_from_slice(&motion.position[frame]);
                pose.qpos[3..7].copy_from_slice(&motion.quaternion[frame]);
                pose.qpos[7..].copy_from_slice(&motion.joints[frame]);
                pose.qvel[..3].copy_from_slice(&motion.velocity[frame]);
                pose.qvel[3..6].copy_from_slice(&motion.angular_velocity[frame]);
                pose.qvel[6..].copy_from_slice(&motion.joints_velocity[frame]);
                pose.position_mut()[..2].fill(0.0);
                let heading = pose.heading();
                poses.push(pose.turned(UP, -heading));
            }
        }
        if poses.is_empty() { Err(Error::NoClips) } else { Ok(Self(poses)) }
    }

    pub(crate) fn draw(&self, random: &mut impl Rng) -> Pose {
        // There is at least one pose.
        self.0[random.random_range(0..self.0.len())]
    }
}

/// The vertical.
pub(crate) const UP: [f64; 3] = [0.0, 0.0, 1.0];
