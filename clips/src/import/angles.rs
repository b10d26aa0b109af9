//! Moves recorded angles into the ranges of the body's joints.

use std::f64::consts::{PI, TAU};
use std::ops::Range;

use comic_experiment::statistics::median;

use super::skeleton::BONES;
use crate::body::joint;
use crate::humanoid::JOINT_RANGES;

/// Thumb angles of a resting hand, rad. Thumbs are noise in CMU's recordings.
pub(crate) const THUMBS: [(usize, f64); 4] =
    [(joint("lthumbrz"), 0.0), (joint("lthumbrx"), 0.3), (joint("rthumbrz"), 0.0), (joint("rthumbrx"), 0.3)];

/// Angles of every recorded frame, rad, in the order of [`JOINTS`](crate::JOINTS).
pub(super) struct Fitted {
    /// Moved by whole turns towards the ranges; may be outside them.
    pub(super) free: Vec<[f64; 56]>,
    /// Clamped to the ranges.
    pub(super) joints: Vec<[f64; 56]>,
}

/// Moves `recorded` angles (rad) by whole turns to fit the ranges best, then clamps them.
///
/// The angles of a bone with one or two hinges are unwrapped in time, so they do not jump. Then all frames are moved by
/// the same whole turns, found from the median over the frames `clip`. For a bone with three hinges two triples of
/// angles give the same rotation; each frame uses the triple that is less outside the ranges.
pub(super) fn fit(recorded: &[[f64; 56]], clip: &Range<usize>) -> Fitted {
    let mut free = recorded.to_vec();
    for bone in &BONES {
        let joints: Vec<usize> = bone.joints().collect();
        if let [x, y, z] = joints[..] {
            free.iter_mut().for_each(|angles| nearer_triple(angles, [x, y, z]));
        } else {
            joints.into_iter().for_each(|joint| unwrap(&mut free, joint, clip));
        }
    }
    let mut joints = free.clone();
    for angles in &mut joints {
        for (angle, [low, high]) in angles.iter_mut().zip(JOINT_RANGES) {
            *angle = angle.clamp(low, high);
        }
        for (thumb, angle) in THUMBS {
            angles[thumb] = angle;
        }
    }
    Fitted { free, joints }
}

/// The angle, moved by whole turns to within half a turn of the middle of the joint's range, rad.
pub(super) fn wrap(angle: f64, joint: usize) -> f64 {
    angle - turns(angle, joint)
}

/// Distance of the angle to the joint's range, rad; 0 inside the range.
pub(super) fn excess(angle: f64, joint: usize) -> f64 {
    let [low, high] = JOINT_RANGES[joint];
    (low - angle).max(angle - high).max(0.0)
}

/// The whole turns between an angle and the middle of the joint's range, rad.
fn turns(angle: f64, joint: usize) -> f64 {
    let [low, high] = JOINT_RANGES[joint];
    TAU * ((angle - (low + high) / 2.0) / TAU + 0.5).floor()
}

/// Sets the angles of a bone to the equivalent triple with the least squared distance to the ranges.
fn nearer_triple(angles: &mut [f64; 56], [x, y, z]: [usize; 3]) {
    let joints = [x, y, z];
    let same = [angles[x], angles[y], angles[z]];
    let other = [angles[x] + PI, PI - angles[y], angles[z] + PI];
    let wrapped = |triple: [f64; 3]| [wrap(triple[0], x), wrap(triple[1], y), wrap(triple[2], z)];
    let cost = |triple: [f64; 3]| joints.iter().zip(triple).map(|(joint, angle)| excess(angle, *joint).powi(2)).sum();
    let (same, other) = (wrapped(same), wrapped(other));
    let (same_cost, other_cost): (f64, f64) = (cost(same), cost(other));
    let chosen = if other_cost < same_cost { other } else { same };
    for (joint, angle) in joints.into_iter().zip(chosen) {
        angles[joint] = angle;
    }
}

/// Removes jumps of half a turn or more, then moves all frames by the same whole turns.
fn unwrap(frames: &mut [[f64; 56]], joint: usize, clip: &Range<usize>) {
    let mut offset = 0.0;
    let mut last = frames.first().map_or(0.0, |angles| angles[joint]);
    for angles in frames.iter_mut() {
        let step = angles[joint] - last;
        last = angles[joint];
        if step.abs() >= PI {
            let short = (step + PI).rem_euclid(TAU) - PI;
            // A jump of exactly half a turn keeps its sign.
            offset += if short == -PI && step > 0.0 { TAU } else { 0.0 } + short - step;
        }
        angles[joint] += offset;
    }
    let turns =
        turns(median(frames[clip.clone()].iter().map(|angles| angles[joint]).collect()).unwrap_or_default(), joint);
    frames.iter_mut().for_each(|angles| angles[joint] -= turns);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recorded(name: &'static str, angles: &[f64]) -> (usize, Vec<[f64; 56]>) {
        let place = crate::humanoid::JOINTS.iter().position(|joint| *joint == name).unwrap();
        let frame = |angle: &f64| std::array::from_fn(|joint| if joint == place { *angle } else { 0.0 });
        (place, angles.iter().map(frame).collect())
    }

    #[test]
    fn unwraps_a_spinning_angle_and_moves_it_by_whole_turns() {
        let (knee, frames) = recorded("ltibiarx", &[0.5 + TAU, 1.0 + TAU, 1.5, 2.0 - TAU]);
        let fitted = fit(&frames, &(0..4));
        let expected = [0.5, 1.0, 1.5, 2.0];
        for (frame, expected) in fitted.free.iter().zip(expected) {
            assert!((frame[knee] - expected).abs() < 1e-12, "{} is not {expected}", frame[knee]);
        }
    }

    #[test]
    fn a_replaced_triple_of_angles_gives_the_same_rotation() {
        use crate::spatial::{about, matrix, multiply};
        let places = ["lfemurrx", "lfemurry", "lfemurrz"].map(|name| recorded(name, &[0.0]).0);
        let mut frame = [0.0; 56];
        for (place, angle) in places.into_iter().zip([2.9, 3.0, -3.0]) {
            frame[place] = angle;
        }
        let fitted = fit(&[frame], &(0..1)).free[0];
        let turned = |angles: &[f64; 56]| {
            let [x, y, z] = places.map(|place| angles[place]);
            matrix(multiply(about(2, z), multiply(about(1, y), about(0, x))))
        };
        assert!(places.iter().all(|place| excess(fitted[*place], *place) < 0.1), "{fitted:?}");
        for (a, b) in turned(&fitted).as_flattened().iter().zip(turned(&frame).as_flattened()) {
            assert!((a - b).abs() < 1e-12);
        }
    }

    #[test]
    fn thumbs_get_the_angles_of_a_resting_hand() {
        let (thumb, frames) = recorded("rthumbrx", &[9.0]);
        assert_eq!(fit(&frames, &(0..1)).joints[0][thumb], 0.3);
    }
}
