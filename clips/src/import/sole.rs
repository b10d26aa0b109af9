//! How far a subject's ankles hold the body's soles from level.

use comic_experiment::statistics::median;

use crate::body::{Frames, body, joint};
use crate::spatial::{Quaternion, Vector, dot, norm, subtract};

/// From heel to ball, in the foot's frame: the sole of the body, which is inclined in it. An ankle angle as recorded
/// puts the body's toes into the floor where the subject stands flat.
const SOLE: Vector = [0.0, -0.1886, -0.0343];
/// m/s: a foot stands when neither ankle nor toes move faster; the looser ones count where nothing stands so still.
const STANDING: [f64; 3] = [0.12, 0.25, 0.5];
/// Frames that must stand for their median to be a subject's.
const FEWEST: usize = 12;
/// s: a recorded frame.
const FRAME: f64 = 1.0 / 120.0;

/// Ankle joint, foot and toes, left then right.
const FEET: [(usize, usize, usize); 2] =
    [(joint("lfootrx"), body("lfoot"), body("ltoes")), (joint("rfootrx"), body("rfoot"), body("rtoes"))];

/// How far the sole of the foot `foot` points up, rad.
pub(super) fn pitch(frames: &Frames, foot: usize) -> f64 {
    (dot(&frames.rotation[foot][2], &SOLE) / norm(&SOLE)).clamp(-1.0, 1.0).asin()
}

/// What to take off the ankles, degrees, left and right: the median by which standing soles point down, to half a
/// degree; `None` for a foot that never stands. `poses` are root and joints of recorded frames.
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

/// Takes `degrees` off the ankles, left and right.
pub(super) fn correct(angles: &mut [f64; 56], degrees: [f64; 2]) {
    for ((ankle, _, _), degrees) in FEET.into_iter().zip(degrees) {
        angles[ankle] -= degrees.to_radians();
    }
}
