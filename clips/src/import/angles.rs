//! Recorded angles as joint angles within the body's ranges.

use std::f64::consts::{PI, TAU};
use std::ops::Range;

use comic_experiment::statistics::median;

use super::skeleton::BONES;
use crate::body::joint;
use crate::humanoid::JOINT_RANGES;

/// Thumbs are noise in CMU's recordings; these angles (rad) are a resting hand's.
const THUMBS: [(usize, f64); 4] =
    [(joint("lthumbrz"), 0.0), (joint("lthumbrx"), 0.3), (joint("rthumbrz"), 0.0), (joint("rthumbrx"), 0.3)];

/// Angles of every recorded frame, rad.
pub(super) struct Fitted {
    /// Each moved by whole turns to where the ranges are, and still free to leave them.
    pub(super) free: Vec<[f64; 56]>,
    /// Within the ranges.
    pub(super) joints: Vec<[f64; 56]>,
}

/// `recorded` (rad) in the turn that suits the ranges best, then clamped to them. Bones with one or two angles are
/// unwrapped in time, so that nothing jumps, and moved as a whole by the median over `clip`; bones with three have two
/// equal triples of angles, of which each frame takes the one that leaves the ranges less.
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

/// The angle, moved by whole turns to within half a turn of the middle of the joint's range.
pub(super) fn wrap(angle: f64, joint: usize) -> f64 {
    angle - turns(angle, joint)
}

/// How far outside the joint's range, rad.
pub(super) fn excess(angle: f64, joint: usize) -> f64 {
    let [low, high] = JOINT_RANGES[joint];
    (low - angle).max(angle - high).max(0.0)
}

/// The whole turns, rad, between an angle and the middle of the joint's range.
fn turns(angle: f64, joint: usize) -> f64 {
    let [low, high] = JOINT_RANGES[joint];
    TAU * ((angle - (low + high) / 2.0) / TAU + 0.5).floor()
}

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

/// Takes out jumps of more than half a turn, then moves all frames by the same turns.
fn unwrap(frames: &mut [[f64; 56]], joint: usize, clip: &Range<usize>) {
    let mut offset = 0.0;
    let mut last = frames.first().map_or(0.0, |angles| angles[joint]);
    for angles in frames.iter_mut() {
        let step = angles[joint] - last;
        last = angles[joint];
        if step.abs() >= PI {
            let short = (step + PI).rem_euclid(TAU) - PI;
            // Half a turn keeps its sign.
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
    fn an_angle_that_spins_is_unwrapped_and_brought_back_by_whole_turns() {
        let (knee, frames) = recorded("ltibiarx", &[0.5 + TAU, 1.0 + TAU, 1.5, 2.0 - TAU]);
        let fitted = fit(&frames, &(0..4));
        let expected = [0.5, 1.0, 1.5, 2.0];
        for (frame, expected) in fitted.free.iter().zip(expected) {
            assert!((frame[knee] - expected).abs() < 1e-12, "{} is not {expected}", frame[knee]);
        }
    }

    #[test]
    fn three_angles_may_become_their_twins_which_turn_the_same() {
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
    fn thumbs_rest() {
        let (thumb, frames) = recorded("rthumbrx", &[9.0]);
        assert_eq!(fit(&frames, &(0..1)).joints[0][thumb], 0.3);
    }
}
