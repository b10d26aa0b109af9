//! The kinds of defects and their limits.

use serde::Serialize;

use crate::error::Error;

/// m: how deep a geom may sink into the floor, the plane z = 0.
pub const PENETRATION: f64 = 0.02;
/// m: what is higher above the floor than this, is in the air.
pub const AIRBORNE: f64 = 0.05;
/// s: longest flight; a person's centre of mass that rises by 0.8 m is back after that time.
pub const LONGEST_FLIGHT: f64 = 0.8;
/// rad: how far a joint may leave its range.
pub const JOINT_EXCESS: f64 = 0.01;
/// m/s: fastest root; sprinters reach 12, and clips are scaled by up to 1.4.
pub const ROOT_SPEED: f64 = 17.0;
/// rad/s: fastest turn of the root; skaters reach 30.
pub const ROOT_TURN: f64 = 35.0;
/// rad/s: fastest joint; kicks and throws of recorded clips reach 25.
pub const JOINT_SPEED: f64 = 40.0;

/// What is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Kind {
    /// A dataset or attribute is missing, mis-shaped or damaged; `detail` has the reason.
    Unreadable,
    /// NaN or infinity; `worst` is how many such numbers.
    NotFinite,
    /// A quaternion's norm is not 1; `worst` is how far off.
    QuaternionNorm,
    /// A joint leaves its range by more than [`JOINT_EXCESS`]; `worst` in rad.
    JointLimit,
    /// A geom is deeper in the floor than [`PENETRATION`]; `worst` in m.
    Penetration,
    /// The whole body is above [`AIRBORNE`] for longer than [`LONGEST_FLIGHT`]; `worst` is its height in m.
    Floating,
    /// The root or a joint moves faster from one frame to the next than [`ROOT_SPEED`], [`ROOT_TURN`] or
    /// [`JOINT_SPEED`]; `worst` in m/s or rad/s.
    Jump,
}

/// One defect of a clip.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Defect {
    /// What is wrong.
    pub kind: Kind,
    /// Where: a dataset, a joint, a geom, or `root`.
    pub item: String,
    /// In how many frames.
    pub frames: usize,
    /// The first of them.
    pub first_frame: usize,
    /// The worst of it, in the kind's unit; 0 for what has no size.
    pub worst: f64,
    /// In words.
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
