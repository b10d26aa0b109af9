//! Bodies that stand still where they would fall over.

use super::defect::{Defect, IMPOSSIBLE, Kind, OVERHANG, STILL, STILL_TIME};
use super::pose::{Pose, ranges};
use super::tally::Stretches;
use crate::spatial::{norm, subtract};

/// The frames in which the body stands still, far beside its support. `dt` is the time step, s.
pub(super) fn unbalanced(poses: &[Option<Pose>], dt: f64) -> Option<Defect> {
    let mut found = Stretches::default();
    let still = |frame: usize, pose: &Pose| {
        let before = frame.checked_sub(1).and_then(|before| poses[before].as_ref());
        before.is_some_and(|before| norm(&subtract(pose.center, before.center)) < STILL * dt)
    };
    let overhangs = |pose: &Pose| pose.overhang.filter(|overhang| *overhang > OVERHANG);
    for range in ranges(poses, |frame, pose| overhangs(pose).is_some() && still(frame, pose)) {
        if range.len() as f64 * dt <= STILL_TIME {
            continue;
        }
        let worst = poses[range.clone()].iter().flatten().filter_map(overhangs).fold(0.0, f64::max);
        found.add(range, worst, |frames| {
            format!(
                "{IMPOSSIBLE}: in {frames} the body keeps still, and its centre of mass is {worst:.2} m beside all that \
                 touches the floor; it would fall over"
            )
        });
    }
    found.defect(Kind::Unbalanced, "root")
}
