//! The CMU humanoid's hinges in the two orders that are in use, and the map from a pose to a servo action.

use std::fmt;

/// Hinges in the order of `qpos[7:]` and of every clip: depth first through the bodies, and `rz`, `ry`, `rx` within one
/// body (dm_control's `_CMU_MOCAP_JOINTS`).
#[rustfmt::skip]
pub const JOINTS: [&str; 56] = [
    "lfemurrz", "lfemurry", "lfemurrx", "ltibiarx", "lfootrz", "lfootrx", "ltoesrx", "rfemurrz", "rfemurry",
    "rfemurrx", "rtibiarx", "rfootrz", "rfootrx", "rtoesrx", "lowerbackrz", "lowerbackry", "lowerbackrx",
    "upperbackrz", "upperbackry", "upperbackrx", "thoraxrz", "thoraxry", "thoraxrx", "lowerneckrz", "lowerneckry",
    "lowerneckrx", "upperneckrz", "upperneckry", "upperneckrx", "headrz", "headry", "headrx", "lclaviclerz",
    "lclaviclery", "lhumerusrz", "lhumerusry", "lhumerusrx", "lradiusrx", "lwristry", "lhandrz", "lhandrx",
    "lfingersrx", "lthumbrz", "lthumbrx", "rclaviclerz", "rclaviclery", "rhumerusrz", "rhumerusry", "rhumerusrx",
    "rradiusrx", "rwristry", "rhandrz", "rhandrx", "rfingersrx", "rthumbrz", "rthumbrx",
];

/// Lowest and highest angle of each joint of [`JOINTS`], rad (`humanoid_CMU_V2020.xml`).
#[rustfmt::skip]
#[allow(clippy::approx_constant, reason = "the XML's own digits")]
pub const JOINT_RANGES: [[f64; 2]; 56] = [
    [-1.0472, 1.22173], [-1.22173, 1.22173], [-2.79253, 0.349066], [0.01, 2.96706], [-1.22173, 0.349066],
    [-0.785398, 0.8], [-1.5708, 0.349066], [-1.22173, 1.0472], [-1.22173, 1.22173], [-2.79253, 0.349066],
    [0.01, 2.96706], [-0.349066, 1.22173], [-0.785398, 0.8], [-1.5708, 0.349066], [-0.523599, 0.523599],
    [-0.523599, 0.523599], [-0.349066, 0.785398], [-0.523599, 0.523599], [-0.523599, 0.523599],
    [-0.349066, 0.785398], [-0.523599, 0.523599], [-0.523599, 0.523599], [-0.349066, 0.785398],
    [-0.523599, 0.523599], [-0.523599, 0.523599], [-0.349066, 0.785398], [-0.523599, 0.523599],
    [-0.523599, 0.523599], [-0.349066, 0.785398], [-0.523599, 0.523599], [-0.523599, 0.523599],
    [-0.349066, 0.785398], [0.0, 0.349066], [-0.349066, 0.174533], [-1.1, 1.5708], [-1.5708, 1.5708],
    [-1.0472, 1.5708], [-0.174533, 2.96706], [0.0, 3.14159], [-0.785398, 0.785398], [-1.5708, 1.5708],
    [0.0, 1.5708], [-0.785398, 0.785398], [0.0, 1.57], [-0.349066, 0.0], [-0.174533, 0.349066], [-1.1, 1.5708],
    [-1.5708, 1.5708], [-1.0472, 1.5708], [-0.174533, 2.96706], [-3.14159, 0.0], [-0.785398, 0.785398],
    [-1.5708, 1.5708], [0.0, 1.5708], [-0.785398, 0.785398], [0.0, 1.57],
];

/// Hinges in the order of `ctrl` and of an action: alphabetical, the order in which dm_control adds the position
/// actuators.
#[rustfmt::skip]
pub const ACTUATORS: [&str; 56] = [
    "headrx", "headry", "headrz", "lclaviclery", "lclaviclerz", "lfemurrx", "lfemurry", "lfemurrz", "lfingersrx",
    "lfootrx", "lfootrz", "lhandrx", "lhandrz", "lhumerusrx", "lhumerusry", "lhumerusrz", "lowerbackrx",
    "lowerbackry", "lowerbackrz", "lowerneckrx", "lowerneckry", "lowerneckrz", "lradiusrx", "lthumbrx", "lthumbrz",
    "ltibiarx", "ltoesrx", "lwristry", "rclaviclery", "rclaviclerz", "rfemurrx", "rfemurry", "rfemurrz",
    "rfingersrx", "rfootrx", "rfootrz", "rhandrx", "rhandrz", "rhumerusrx", "rhumerusry", "rhumerusrz",
    "rradiusrx", "rthumbrx", "rthumbrz", "rtibiarx", "rtoesrx", "rwristry", "thoraxrx", "thoraxry", "thoraxrz",
    "upperbackrx", "upperbackry", "upperbackrz", "upperneckrx", "upperneckry", "upperneckrz",
];

/// For each actuator of [`ACTUATORS`], the index of its hinge in [`JOINTS`].
#[rustfmt::skip]
pub const ACTUATOR_JOINTS: [usize; 56] = [
    31, 30, 29, 33, 32, 2, 1, 0, 41, 5, 4, 40, 39, 36, 35, 34, 16, 15, 14, 25, 24, 23, 37, 43, 42, 3, 6, 38, 45,
    44, 9, 8, 7, 53, 12, 11, 52, 51, 48, 47, 46, 49, 55, 54, 10, 13, 50, 22, 21, 20, 19, 18, 17, 28, 27, 26,
];

/// A version of dm_control's CMU humanoid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum WalkerModel {
    /// `humanoid_CMU_V2019.xml`.
    Cmu2019,
    /// `humanoid_CMU_V2020.xml`.
    Cmu2020,
}

impl WalkerModel {
    /// Number of tracking bodies, which are all bodies except the root: 30, or 31 for V2020, which has `face`.
    pub const fn bodies(self) -> usize {
        match self {
            Self::Cmu2019 => 30,
            Self::Cmu2020 => 31,
        }
    }

    /// The value of the attribute `model` in a file.
    pub(crate) fn attribute(self) -> i64 {
        match self {
            Self::Cmu2019 => 1,
            Self::Cmu2020 => 4,
        }
    }

    /// The body with this value of the attribute `model` (`WalkerModel` in dm_control's `mocap.proto`).
    pub(crate) fn from_attribute(number: u64) -> Option<Self> {
        match number {
            1 => Some(Self::Cmu2019),
            4 => Some(Self::Cmu2020),
            _ => None,
        }
    }
}

impl fmt::Display for WalkerModel {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Cmu2019 => "CMU humanoid V2019",
            Self::Cmu2020 => "CMU humanoid V2020",
        })
    }
}

/// The servo action that aims at the pose `joints` (rad, in `qpos` order). The action is in `ctrl` order, and each
/// entry is in [−1, 1].
///
/// u = (2q − (hi + lo)) / (hi − lo), clipped if the pose is beyond the V2020 ranges (dm_control's
/// `cmu_pose_to_actuation`).
pub fn pose_to_action(joints: &[f64; 56]) -> [f64; 56] {
    ACTUATOR_JOINTS.map(|joint| {
        let [low, high] = JOINT_RANGES[joint];
        ((2.0 * joints[joint] - (high + low)) / (high - low)).clamp(-1.0, 1.0)
    })
}
