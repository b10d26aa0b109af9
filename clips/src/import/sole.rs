//! The pitch of the body's soles when the subject stands flat.

use comic_experiment::statistics::median;

use crate::body::{Frames, body, joint};
use crate::spatial::{Quaternion, Vector, dot, norm, subtract};

/// The direction of the body's sole from heel to ball, in the foot's frame. The sole is inclined in this frame: if the
/// subject stands flat, the recorded ankle angle puts the body's toes into the floor.
pub(crate) const SOLE: Vector = [0.0, -0.1886, -0.0343];
/// A foot stands if ankle and toes are slower than this, m/s. The larger limits apply if too few frames are below the
/// smaller ones.
const STANDING: [f64; 3] = [0.12, 0.25, 0.5];
/// Least number of standing frames for a median.
const FEWEST: usize = 12;
/// Duration of a recorded frame, s.
const FRAME: f64 = 1.0 / 120.0;

/// Indices of ankle joint, foot and toes; left, then right.
const FEET: [(usize, usize, usize); 2] =
    [(joint("lfootrx"), body("lfoot"), body("ltoes")), (joint("rfootrx"), body("rfoot"), body("rtoes"))];

/// Pitch of the sole of the body `foot`, rad; positive if the toes point up.
pub(super) fn pitch(frames: &Frames, foot: usize) -> f64 {
    (dot(&frames.rotation[foot][2], &SOLE) / norm(&SOLE)).clamp(-1.0, 1.0).asin()
}

/// The correction to subtract from the ankles, degrees, left and right: the median downward pitch of standing soles,
/// rounded to half a degree. `None` for a foot that never stands. `poses` are the root's position (m) and orientation
/// and the joint angles (rad) of recorded frames.
pub(super) fn find(poses: impl Iterator<Item = (Vector, Quaternion, [f64; 56])>) -> [Option<f64>; 2] {
    let mut stood: [[Vec<f64>; 3]; 2] = Default::default();
    let mut last: Option<Frames> = None;
    for (position, quaternion, joints) in poses {
        let frames = Frames::of(&position, &quaternion, &joints);
        if let Some(last) = &last {
            for ((_, foot, toes), stood) in FEET.into_iter().zip(&mut stood) {
                let speed = |body: usize| norm(&subtract(frames.position[body], last.position[body])) / FRAME;
                let fastest = speed(foot).max(speed(toes));
                for (limit, pitches) in STANDING.into_iter().zip(stood) {
                    if fastest < limit {
                        pitches.push(pitch(&frames, foot).to_degrees());
                    }
                }
            }
        }
        last = Some(frames);
    }
    stood.map(|by_limit| {
        let pitches = by_limit.into_iter().find(|pitches| pitches.len() >= FEWEST)?;
        median(pitches).map(|pitch| (-pitch * 2.0).round() / 2.0)
    })
}

/// Subtracts `degrees`, left and right, from the ankles of `angles` (rad).
pub(super) fn correct(angles: &mut [f64; 56], degrees: [f64; 2]) {
    for ((ankle, _, _), degrees) in FEET.into_iter().zip(degrees) {
        angles[ankle] -= degrees.to_radians();
    }
}
