//! The kinds of defects and their limits.

use serde::Serialize;

use crate::error::Error;

/// How the description of a defect begins that no policy can follow.
pub(super) const IMPOSSIBLE: &str = "cannot be followed";

/// Greatest depth of a geom in the floor (the plane z = 0), m.
pub const PENETRATION: f64 = 0.02;
/// A body that is deeper in the floor than this, m, cannot be followed: contact keeps the simulated body above. Hands,
/// fingers, thumbs and toes are exempt: they can bend away. The real clips are at most 2 mm deep.
pub const DEEP_PENETRATION: f64 = 0.1;
/// A body is in the air if its lowest point is higher than this, m. A wrong floor lifts real clips by up to 4 cm.
pub const AIRBORNE: f64 = 0.05;
/// The simulation's gravity, m/s², in which [`LEAST_FALL`] and [`MOST_FALL`] are counted.
pub const GRAVITY: f64 = 9.81;
/// A flight must be as long as this, s, to tell its acceleration. These are five frames at 0.03 s: an error of 1 mm in each
/// height makes one of 0.05 g.
pub const SHORTEST_FLIGHT: f64 = 0.15;
/// Least downward acceleration of the centre of mass in a flight, g. The motion of a person is scaled to the body by s, 1.09
/// to 1.33 for the subjects of CMU, and time is not, so a flight shows about s g. The six flights of the real clips show 1.00
/// to 1.42 g, the highest jump (CMU_131_07) the most.
pub const LEAST_FALL: f64 = 0.5;
/// Greatest downward acceleration of the centre of mass in a flight, g; see [`LEAST_FALL`].
pub const MOST_FALL: f64 = 2.0;
/// Longest flight, s. A centre of mass that rises by 0.8 m comes down after this time.
pub const LONGEST_FLIGHT: f64 = 0.8;
/// Greatest height, m, that the centre of mass gains in a jump. It rises by 0.78 m in half of [`LONGEST_FLIGHT`]; this is
/// 1.4 times as much, for the scale. The real clips reach 0.50 m (CMU_131_07). A jump of this height out of a squat, 0.5 m
/// lower, takes 1,100 J, for the body has 70 kg. The servos of both legs (`_POSITION_ACTUATORS_V2020`: hip 300, knee 160,
/// ankle 120 N·m) do at most 1,900 J through 1.6, 2.2 and 1 rad, and at 10 rad/s damping takes half of their torque.
pub const HIGHEST_JUMP: f64 = 1.1;
/// Greatest horizontal distance, m, of the centre of mass from the convex hull of what touches the floor, while the body
/// keeps still. Gravity accelerates a centre of mass at a height of 0.9 m there by 2.7 m/s². A body that sits upright on
/// a chair, which the simulation lacks, has 0.38 m, and 0.33 m if it leans forwards by 0.2 rad. The real clips reach
/// 0.03 m while they keep still for [`STILL_TIME`], and 0.13 m in a single such frame.
pub const OVERHANG: f64 = 0.25;
/// The body keeps still while its centre of mass is slower than this, m/s.
pub const STILL: f64 = 0.3;
/// Longest time, s, that a body keeps still beyond [`OVERHANG`]. In this time a falling one reaches 1.4 m/s.
pub const STILL_TIME: f64 = 0.5;
/// Greatest angle of a joint beyond its range, rad.
pub const JOINT_EXCESS: f64 = 0.01;
/// Greatest speed of the root, m/s. Sprinters reach 12, and clips are scaled by up to 1.4. The real clips reach 3.6.
pub const ROOT_SPEED: f64 = 17.0;
/// Greatest angular speed of the root, rad/s. Skaters reach 30.
pub const ROOT_TURN: f64 = 35.0;
/// Greatest angular speed of a joint, rad/s. Kicks and throws in recorded clips reach 27. Most servos of V2020 can keep
/// 20 rad/s: there the joint's damping takes their whole torque (`_POSITION_ACTUATORS_V2020`: 300 N·m and 15 N·m·s/rad).
pub const JOINT_SPEED: f64 = 40.0;
/// In how many frames a joint may be faster than [`JOINT_SPEED`] in a clip that can be followed. An outlier in a recording
/// makes two such frames, out and back; this is one more. The rest of the body can follow meanwhile.
pub const MOST_JUMPS: usize = 3;

/// Kind of a defect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Kind {
    /// A dataset or attribute is missing, has the wrong shape, or is damaged. `detail` gives the reason.
    Unreadable,
    /// A number is NaN or infinite; `worst` is the count of such numbers.
    NotFinite,
    /// The norm of a quaternion is not 1; `worst` is the greatest difference from 1.
    QuaternionNorm,
    /// A joint is more than [`JOINT_EXCESS`] beyond its range; `worst` in rad.
    JointLimit,
    /// A geom is deeper in the floor than [`PENETRATION`]; `worst` in m. Beyond [`DEEP_PENETRATION`] no policy can follow it,
    /// unless only hands, fingers, thumbs or toes are so deep.
    Penetration,
    /// The whole body is higher than [`AIRBORNE`] and hovers, rises or glides: for [`SHORTEST_FLIGHT`] or longer its centre
    /// of mass falls with less than [`LEAST_FALL`]. Or it is there for longer than [`LONGEST_FLIGHT`]. `worst` is its height
    /// in m.
    Floating,
    /// In such a flight the centre of mass falls with more than [`MOST_FALL`]; `worst` in m/s².
    Fall,
    /// In such a flight the centre of mass rises by more than [`HIGHEST_JUMP`]; `worst` in m.
    JumpHeight,
    /// The body keeps still (slower than [`STILL`]) for longer than [`STILL_TIME`] with its centre of mass more than
    /// [`OVERHANG`] beside its support; `worst` in m.
    Unbalanced,
    /// The root or a joint moves faster from one frame to the next than [`ROOT_SPEED`], [`ROOT_TURN`] or
    /// [`JOINT_SPEED`]; `worst` in m/s or rad/s. A joint that does so in up to [`MOST_JUMPS`] frames can be followed.
    Jump,
}

/// One defect of a clip.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Defect {
    /// The kind.
    pub kind: Kind,
    /// The dataset, joint or geom that has the defect, or `root`.
    pub item: String,
    /// Number of frames with the defect.
    pub frames: usize,
    /// The first of these frames.
    pub first_frame: usize,
    /// The worst value, in the unit of the kind; 0 for kinds without a value.
    pub worst: f64,
    /// A description for people.
    pub detail: String,
}

/// The defect of a dataset or attribute, `item`, that cannot be read.
pub(super) fn unreadable(item: &str, error: &Error) -> Defect {
    let detail = match error {
        Error::Malformed { item, reason, .. } => format!("{item}: {reason}"),
        error => error.to_string(),
    };
    Defect { kind: Kind::Unreadable, item: item.into(), frames: 0, first_frame: 0, worst: 0.0, detail }
}
