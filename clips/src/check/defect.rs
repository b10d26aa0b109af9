//! The kinds of defects and their limits.

use serde::Serialize;

use crate::error::Error;

/// Greatest depth of a geom in the floor (the plane z = 0), m.
pub const PENETRATION: f64 = 0.02;
/// A body is in the air if its lowest point is higher than this, m.
pub const AIRBORNE: f64 = 0.05;
/// Longest flight, s. A centre of mass that rises by 0.8 m comes down after this time.
pub const LONGEST_FLIGHT: f64 = 0.8;
/// Greatest angle of a joint beyond its range, rad.
pub const JOINT_EXCESS: f64 = 0.01;
/// Greatest speed of the root, m/s. Sprinters reach 12, and clips are scaled by up to 1.4.
pub const ROOT_SPEED: f64 = 17.0;
/// Greatest angular speed of the root, rad/s. Skaters reach 30.
pub const ROOT_TURN: f64 = 35.0;
/// Greatest angular speed of a joint, rad/s. Kicks and throws in recorded clips reach 25.
pub const JOINT_SPEED: f64 = 40.0;

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
    /// A geom is deeper in the floor than [`PENETRATION`]; `worst` in m.
    Penetration,
    /// The whole body is higher than [`AIRBORNE`] for longer than [`LONGEST_FLIGHT`]; `worst` is its height in m.
    Floating,
    /// The root or a joint moves faster from one frame to the next than [`ROOT_SPEED`], [`ROOT_TURN`] or
    /// [`JOINT_SPEED`]; `worst` in m/s or rad/s.
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
