//! A clip in memory.

use std::ops::RangeInclusive;

use crate::humanoid::WalkerModel;

/// Allowed number of frames: at most 50 minutes at 0.03 s. The longest clip of CMU has 6,371 frames. The limit bounds
/// the memory that a hostile `num_steps` can claim to 340 MB.
pub(crate) const STEPS: RangeInclusive<u64> = 1..=100_000;

/// One whole clip: T frames, `dt` seconds apart.
#[derive(Clone, Debug, PartialEq)]
pub struct Clip {
    /// The clip's name in its file, or a built-in clip's own name.
    pub name: String,
    /// What this clip was made of if it is a copy, for instance `mirror CMU_007_01`; see [`edit`](crate::edit). `None`
    /// for a recording, and for a clip whose file says nothing.
    pub made_from: Option<String>,
    /// The body that the clip was made for.
    pub model: WalkerModel,
    /// Seconds between frames.
    pub dt: f64,
    /// Pose and velocity of root and joints.
    pub motion: Motion,
    /// The quantities that the task compares with the simulated body. `None` for built-in clips: forward kinematics
    /// computes them.
    pub features: Option<Features>,
}

impl Clip {
    /// T, the number of frames.
    pub fn steps(&self) -> usize {
        self.motion.position.len()
    }
}

/// The humanoid's generalised coordinates and velocities. Each field has one entry per frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Motion {
    /// Position of the root, m, world frame, z up.
    pub position: Vec<[f64; 3]>,
    /// Orientation of the root, a unit quaternion w x y z, world frame.
    pub quaternion: Vec<[f64; 4]>,
    /// Joint angles, rad, in the order of [`JOINTS`](crate::JOINTS).
    pub joints: Vec<[f64; 56]>,
    /// Linear velocity of the root, m/s, world frame.
    pub velocity: Vec<[f64; 3]>,
    /// Angular velocity of the root, rad/s, root frame.
    pub angular_velocity: Vec<[f64; 3]>,
    /// Joint velocities, rad/s, in the order of [`JOINTS`](crate::JOINTS).
    pub joints_velocity: Vec<[f64; 56]>,
}

/// Quantities that follow from the pose, as a file stores them. B is [`WalkerModel::bodies`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Features {
    /// Centre of mass of the whole body, m, world frame, one entry per frame.
    pub center_of_mass: Vec<[f64; 3]>,
    /// Positions of rradius, lradius, rfoot and lfoot relative to the root, m, root frame, one entry per frame.
    pub end_effectors: Vec<[f64; 12]>,
    /// The same for these four bodies and then the head.
    pub appendages: Vec<[f64; 15]>,
    /// Positions of the tracking bodies, `[T, B, 3]`, m, world frame.
    pub body_positions: Vec<f64>,
    /// Orientations of the tracking bodies, `[T, B, 4]`, w x y z, world frame.
    pub body_quaternions: Vec<f64>,
}
