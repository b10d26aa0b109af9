//! What the pose of one frame says about the body and the floor.

use std::ops::Range;

use super::defect::AIRBORNE;
use crate::body::{Frames, body, geoms};
use crate::spatial::Vector;

/// The bodies that are small enough to bend away: a policy can keep them above the floor and follow all others.
const SMALL: [usize; 8] = [
    body("lhand"),
    body("lfingers"),
    body("lthumb"),
    body("ltoes"),
    body("rhand"),
    body("rfingers"),
    body("rthumb"),
    body("rtoes"),
];

/// Directions in which the support is measured. Between two of them, 5° apart, the distance is at most 0.1 % too small.
const DIRECTIONS: usize = 72;

/// The body above the floor, z = 0.
pub(super) struct Pose {
    /// Height of the lowest point, m.
    pub(super) lowest: f64,
    /// The geom that has it.
    pub(super) geom: &'static str,
    /// Height of the lowest point of all geoms but those of hands, fingers, thumbs and toes, m.
    pub(super) lowest_large: f64,
    /// Centre of mass, m, world frame.
    pub(super) center: Vector,
    /// Horizontal distance of the centre of mass from the support, m; 0 above it. `None` if no geom is near the floor.
    pub(super) overhang: Option<f64>,
}

impl Pose {
    /// The pose of the root at `position` (m) and `quaternion`, and the hinges at `joints` (rad).
    pub(super) fn of(position: &Vector, quaternion: &[f64; 4], joints: &[f64; 56]) -> Self {
        let frames = Frames::of(position, quaternion, joints);
        let (lowest, geom) = frames.lowest();
        let center = frames.center_of_mass();
        let overhang = overhang(&frames, center);
        let lowest_large = geoms()
            .iter()
            .filter(|geom| !SMALL.contains(&geom.body))
            .map(|geom| frames.bottom(geom))
            .fold(f64::INFINITY, f64::min);
        Self { lowest, geom: geom.name, lowest_large, center, overhang }
    }
}

/// Horizontal distance of `center` from the convex hull of the supports. A support is the lowest point of a geom, or of
/// each end of a capsule, if it is at most [`AIRBORNE`] above the floor.
fn overhang(frames: &Frames, center: Vector) -> Option<f64> {
    let supports: Vec<Vector> =
        geoms().iter().flat_map(|geom| frames.low_points(geom)).filter(|point| point[2] <= AIRBORNE).collect();
    // The distance from a convex set is the greatest over all directions of how far the point is beyond the set.
    let beyond = |direction: usize| {
        let (sin, cos) = (std::f64::consts::TAU * direction as f64 / DIRECTIONS as f64).sin_cos();
        let from = |place: &Vector| cos * (center[0] - place[0]) + sin * (center[1] - place[1]);
        supports.iter().map(from).fold(f64::INFINITY, f64::min)
    };
    (!supports.is_empty()).then(|| (0..DIRECTIONS).map(beyond).fold(0.0, f64::max))
}

/// The ranges of successive frames that have a pose for which `holds` is true, as long as possible.
pub(super) fn ranges(poses: &[Option<Pose>], holds: impl Fn(usize, &Pose) -> bool) -> Vec<Range<usize>> {
    let mut ranges: Vec<Range<usize>> = Vec::new();
    for (frame, pose) in poses.iter().enumerate() {
        if !pose.as_ref().is_some_and(|pose| holds(frame, pose)) {
            continue;
        }
        match ranges.last_mut() {
            Some(range) if range.end == frame => range.end += 1,
            _ => ranges.push(frame..frame + 1),
        }
    }
    ranges
}
