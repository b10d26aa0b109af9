//! Bodies in the floor.

use super::defect::{DEEP_PENETRATION, Defect, IMPOSSIBLE, Kind, PENETRATION};
use super::pose::{Pose, ranges};
use super::tally::Stretches;

/// Minimum and maximum of the height of the body's lowest point, m.
pub(super) fn lowest_point(poses: &[Option<Pose>]) -> Option<[f64; 2]> {
    poses
        .iter()
        .flatten()
        .map(|pose| [pose.lowest; 2])
        .reduce(|[low, high], [height, _]| [low.min(height), high.max(height)])
}

/// The frames in which a geom is in the floor, and the deepest geom.
pub(super) fn penetration(poses: &[Option<Pose>]) -> Option<Defect> {
    let (mut found, mut worst, mut deepest) = (Stretches::default(), 0.0, "");
    for range in ranges(poses, |_, pose| pose.lowest < -PENETRATION) {
        let (mut depth, mut geom) = (0.0, "");
        for pose in poses[range.clone()].iter().flatten() {
            if -pose.lowest > depth {
                (depth, geom) = (-pose.lowest, pose.geom);
            }
        }
        if depth > worst {
            (worst, deepest) = (depth, geom);
        }
        found.add(range, depth, |_| format!("{depth:.3} m deep in the floor"));
    }
    let mut defect = found.defect(Kind::Penetration, deepest)?;
    // A hand can be deeper in other frames than the body; the description is about the body.
    if let Some(deep) = deep(poses) {
        defect.detail = deep.detail;
    }
    Some(defect)
}

/// The frames in which the body is too deep in the floor to be followed.
fn deep(poses: &[Option<Pose>]) -> Option<Defect> {
    let mut found = Stretches::default();
    for range in ranges(poses, |_, pose| pose.lowest_large < -DEEP_PENETRATION) {
        let depth = poses[range.clone()].iter().flatten().map(|pose| -pose.lowest_large).fold(0.0, f64::max);
        found.add(range, depth, |frames| {
            format!(
                "{IMPOSSIBLE}: the body goes through the floor, up to {depth:.3} m deep in {frames}; raise the clip, \
                 or import it with another --floor"
            )
        });
    }
    found.defect(Kind::Penetration, "root")
}
