//! What the body is made of: rigid bodies and colliding geoms.

use crate::spatial::{Quaternion, Vector};

/// A rigid body. Its frame is at `position` (m) and `quaternion` in the frame of its parent.
pub(crate) struct Body {
    pub(crate) name: &'static str,
    /// Index of the parent in the table.
    pub(super) parent: usize,
    /// The first of its hinges in [`JOINTS`](crate::humanoid::JOINTS), and one past the last. They turn in that order.
    pub(super) hinges: (usize, usize),
    pub(super) position: Vector,
    pub(super) quaternion: Quaternion,
    /// Position of its hinges in its own frame, m.
    pub(super) anchor: Vector,
    /// kg.
    pub(super) mass: f64,
    /// In its own frame, m.
    pub(super) center_of_mass: Vector,
}

/// A colliding geom at `position` (m) and `quaternion` in the frame of the body with index `body`.
pub(crate) struct Geom {
    pub(crate) name: &'static str,
    pub(crate) body: usize,
    pub(super) shape: Shape,
    pub(super) position: Vector,
    pub(super) quaternion: Quaternion,
}

/// The shape of a geom. Lengths in m; the axis of a capsule is the geom's z axis.
pub(super) enum Shape {
    Sphere { radius: f64 },
    Capsule { radius: f64, half_length: f64 },
    Ellipsoid { semi_axes: Vector },
}
