//! The skeleton: SMPL's first 22 joints in the rest pose of a person of average proportions.
//!
//! Names and tree are those of SMPL (Loper et al. 2015). No length comes from SMPL. Unless a comment says otherwise, a
//! place is a share of the stature by Drillis and Contini (1966), as in Winter, Biomechanics and Motor Control of Human
//! Movement (2009), figure 4.1.

use super::super::recorded::RecordedBone;
use crate::spatial::{Vector, scale, subtract};

/// Height of the hip joints.
const HIP: f64 = 0.530;
/// Height of the knees.
const KNEE: f64 = 0.285;
/// Height of the ankles above the soles.
pub(super) const ANKLE: f64 = 0.039;
/// Height of the shoulders.
const SHOULDER: f64 = 0.818;
/// From the middle to the shoulder joint: half the width of the shoulders.
const SHOULDER_SIDE: f64 = 0.129;
/// Length of the upper arm.
const UPPER_ARM: f64 = 0.186;
/// Length of the forearm.
const FOREARM: f64 = 0.146;
/// Length of the hand with its fingers.
const HAND: f64 = 0.108;
/// Height of the chin.
const CHIN: f64 = 0.870;
/// Height of the eyes.
const EYES: f64 = 0.936;
/// Length of the foot.
const FOOT: f64 = 0.152;

/// Distance between the anterior superior iliac spines: about 0.23 m at a stature of 1.7 m.
const SPINES: f64 = 0.135;
/// From the middle to the hip joint. The joint is 14 % of the distance of the iliac spines nearer to the middle than the
/// spine (Bell, Brand and Pedersen 1989).
const HIP_SIDE: f64 = (0.5 - 0.14) * SPINES;
/// Height of the pelvis' joint: that of the iliac spines, 30 % of their distance above the hip joints (Bell, Brand and
/// Pedersen 1989).
const PELVIS: f64 = HIP + 0.30 * SPINES;
/// Height of the base of the neck: halfway between the shoulders and the chin.
const NECK: f64 = (SHOULDER + CHIN) / 2.0;
/// Height of the joint of the head: halfway between chin and eyes, near the ears.
const HEAD: f64 = (CHIN + EYES) / 2.0;
/// Distance of the joints of the spine, which are spaced evenly.
const SPINE: f64 = (NECK - PELVIS) / 4.0;
/// From the middle to the joint of the collarbone: about 0.025 m.
const COLLAR_SIDE: f64 = 0.015;
/// From the ankle forward to the ball. Seen from the heel, the ankle is at a quarter of the foot and the ball at three
/// quarters.
const BALL: f64 = 0.5 * FOOT;
/// From the ball to the tip of the toes.
const TOES: f64 = 0.25 * FOOT;
/// Height of the joint of the ball above the sole: about 0.025 m.
pub(super) const BALL_HEIGHT: f64 = 0.015;

/// Indices of the joints that are near the soles, with their heights above them as shares of the stature.
pub(super) const SOLES: [(usize, f64); 4] = [(7, ANKLE), (8, ANKLE), (10, BALL_HEIGHT), (11, BALL_HEIGHT)];
/// Index of the neck.
pub(super) const NECK_JOINT: usize = 12;

/// Name, parent, and place in the rest pose: to the left, up and forward of the point between the soles.
const REST: [(&str, Option<usize>, Vector); super::JOINTS] = [
    ("pelvis", None, [0.0, PELVIS, 0.0]),
    ("left_hip", Some(0), [HIP_SIDE, HIP, 0.0]),
    ("right_hip", Some(0), [-HIP_SIDE, HIP, 0.0]),
    ("spine1", Some(0), [0.0, PELVIS + SPINE, 0.0]),
    ("left_knee", Some(1), [HIP_SIDE, KNEE, 0.0]),
    ("right_knee", Some(2), [-HIP_SIDE, KNEE, 0.0]),
    ("spine2", Some(3), [0.0, PELVIS + 2.0 * SPINE, 0.0]),
    ("left_ankle", Some(4), [HIP_SIDE, ANKLE, 0.0]),
    ("right_ankle", Some(5), [-HIP_SIDE, ANKLE, 0.0]),
    ("spine3", Some(6), [0.0, PELVIS + 3.0 * SPINE, 0.0]),
    ("left_foot", Some(7), [HIP_SIDE, BALL_HEIGHT, BALL]),
    ("right_foot", Some(8), [-HIP_SIDE, BALL_HEIGHT, BALL]),
    ("neck", Some(9), [0.0, NECK, 0.0]),
    ("left_collar", Some(9), [COLLAR_SIDE, SHOULDER, 0.0]),
    ("right_collar", Some(9), [-COLLAR_SIDE, SHOULDER, 0.0]),
    ("head", Some(12), [0.0, HEAD, 0.0]),
    ("left_shoulder", Some(13), [SHOULDER_SIDE, SHOULDER, 0.0]),
    ("right_shoulder", Some(14), [-SHOULDER_SIDE, SHOULDER, 0.0]),
    ("left_elbow", Some(16), [SHOULDER_SIDE + UPPER_ARM, SHOULDER, 0.0]),
    ("right_elbow", Some(17), [-SHOULDER_SIDE - UPPER_ARM, SHOULDER, 0.0]),
    ("left_wrist", Some(18), [SHOULDER_SIDE + UPPER_ARM + FOREARM, SHOULDER, 0.0]),
    ("right_wrist", Some(19), [-SHOULDER_SIDE - UPPER_ARM - FOREARM, SHOULDER, 0.0]),
];

/// The bones of a person of that stature, m.
pub(super) fn bones(stature: f64) -> Vec<RecordedBone> {
    let place = |index: usize| REST.get(index).map(|(_, _, place)| *place).unwrap_or_default();
    let end = |name: &str| match name {
        "head" => Some([0.0, 1.0 - HEAD, 0.0]),
        "left_wrist" => Some([HAND, 0.0, 0.0]),
        "right_wrist" => Some([-HAND, 0.0, 0.0]),
        "left_foot" | "right_foot" => Some([0.0, 0.0, TOES]),
        _ => None,
    };
    let bone = |(name, parent, rest): &(&str, Option<usize>, Vector)| RecordedBone {
        name: (*name).into(),
        parent: *parent,
        offset: scale(stature, subtract(*rest, parent.map(place).unwrap_or_default())),
        end: end(name).map(|end| scale(stature, end)),
    };
    REST.iter().map(bone).collect()
}
