//! Finds the stature of a person from the motion.
//!
//! The file says how the pelvis moves, in m, but not how long the legs are. A foot on the floor shows it: when the knees
//! bend, the pelvis moves down by as much as the legs, in stature, become shorter.

use super::super::axes::Axis;
use super::super::recorded::{Recorded, RecordedPose};
use super::body::{NECK_JOINT, SOLES};
use crate::spatial::{Vector, add, dot, multiply, norm, rotated, scale, subtract};
use comic_experiment::statistics::median;

/// The stature if the motion does not tell it, m.
pub(super) const AVERAGE: f64 = 1.7;
/// The statures that are tried, cm.
const CENTIMETERS: std::ops::RangeInclusive<u32> = 120..=210;
/// Least range of the height of the pelvis above the feet, as a share of the stature. The steps of a walk have about 0.02,
/// which the errors of the proportions would dominate.
const BEND: f64 = 0.06;
/// Greatest median distance of the soles from one height, m, at which they are on one floor. It is more than the error of
/// the proportions; on a slope or on stairs the soles have other heights for most of the time.
const ONE_FLOOR: f64 = 0.03;
/// Greatest number of frames that are used, spaced evenly.
const MOST: usize = 2000;

/// A frame: height of the pelvis (m), and of the lowest sole seen from the pelvis (share of the stature, negative).
struct Sample {
    pelvis: f64,
    sole: f64,
}

/// The stature, m, at which the height of the lowest sole varies least. `unit` has a stature of 1 m.
///
/// # Errors
/// The reason why the motion does not tell it: the legs bend too little, or the feet are on one floor at no stature.
pub(super) fn find(unit: &Recorded) -> Result<f64, &'static str> {
    let frames = unit.frames.iter().step_by(unit.frames.len().div_ceil(MOST).max(1));
    let places: Vec<(Vector, Vec<Vector>)> = frames.map(|pose| (pose.position, joints(unit, pose))).collect();
    let up = up(places.iter().map(|(_, joints)| joints.as_slice()));
    let samples: Vec<Sample> = places
        .iter()
        .map(|(position, joints)| {
            let soles = SOLES.iter().filter_map(|(joint, height)| Some(dot(joints.get(*joint)?, &up) - height));
            Sample { pelvis: dot(position, &up), sole: soles.fold(f64::INFINITY, f64::min) }
        })
        .collect();
    let mut bends: Vec<f64> = samples.iter().map(|sample| sample.sole).collect();
    bends.sort_by(f64::total_cmp);
    let at = |percent: usize| bends.get((bends.len() - 1) * percent / 100).copied().unwrap_or_default();
    if at(95) - at(5) < BEND {
        return Err("the legs bend too little to find it");
    }
    let heights = |stature: u32| -> Vec<f64> {
        samples.iter().map(|sample| sample.pelvis + f64::from(stature) / 100.0 * sample.sole).collect()
    };
    // Frames in the air change a mean distance less than they would change a variance.
    let spread = |stature: u32| {
        let distances = distances(heights(stature));
        distances.iter().sum::<f64>() / distances.len().max(1) as f64
    };
    // The spread is a convex function of the stature, so there is one least value.
    let best = CENTIMETERS.min_by(|a, b| spread(*a).total_cmp(&spread(*b))).unwrap_or_default();
    let inside = best > *CENTIMETERS.start() && best < *CENTIMETERS.end();
    // A jump does not change a median.
    match inside && median(distances(heights(best))).is_some_and(|rest| rest < ONE_FLOOR) {
        true => Ok(f64::from(best) / 100.0),
        false => Err("the feet are on one floor at no stature from 1.2 to 2.1 m"),
    }
}

/// The places of the joints relative to the pelvis, in the world's axes.
fn joints(recorded: &Recorded, pose: &RecordedPose) -> Vec<Vector> {
    let mut places: Vec<(Vector, [f64; 4])> = Vec::with_capacity(recorded.bones.len());
    for (bone, rotation) in recorded.bones.iter().zip(&pose.rotations) {
        let placed = match bone.parent.and_then(|parent| places.get(parent)) {
            Some((place, outer)) => (add(*place, rotated(*outer, bone.offset)), multiply(*outer, *rotation)),
            None => ([0.0; 3], *rotation),
        };
        places.push(placed);
    }
    places.into_iter().map(|(place, _)| place).collect()
}

/// The coordinate axis nearest to the mean direction from the feet to the neck. It is z in AMASS, y in some data sets.
fn up<'a>(frames: impl Iterator<Item = &'a [Vector]>) -> Vector {
    let mut sum = [0.0; 3];
    for joints in frames {
        let [left, right, ..] = SOLES.map(|(joint, _)| joints.get(joint).copied().unwrap_or_default());
        let neck = joints.get(NECK_JOINT).copied().unwrap_or_default();
        let body = subtract(neck, scale(0.5, add(left, right)));
        sum = add(sum, scale(1.0 / norm(&body).max(1e-9), body));
    }
    Axis::nearest(&sum).direction()
}

/// The distances of the values from their median.
fn distances(values: Vec<f64>) -> Vec<f64> {
    let middle = median(values.clone()).unwrap_or_default();
    values.into_iter().map(|value| (value - middle).abs()).collect()
}
