//! The CMU humanoid V2020 as rigid bodies: forward kinematics, centre of mass, and height above the floor.

mod parts;
mod table;

pub(crate) use parts::Geom;
use parts::Shape;

use crate::humanoid::JOINTS;
use crate::spatial::{
    IDENTITY, Matrix, Quaternion, Vector, about, add, matrix, multiply, norm, normalize, rotate, scale, subtract,
    unrotate,
};

/// The number of bodies, with the free frame and the root.
pub(crate) const BODIES: usize = table::BODIES.len();
/// Index of the root. The bodies after it are the tracking bodies, in dm_control's order.
pub(crate) const ROOT: usize = 1;

/// Position and orientation of every body in the world frame.
pub(crate) struct Frames {
    /// m.
    pub(crate) position: [Vector; BODIES],
    pub(crate) quaternion: [Quaternion; BODIES],
    pub(crate) rotation: [Matrix; BODIES],
    /// The axis of each joint of [`JOINTS`], a unit vector.
    pub(crate) axis: [Vector; 56],
}

/// Index of the body with this name.
pub(crate) fn index(name: &str) -> Option<usize> {
    table::BODIES.iter().position(|body| body.name == name)
}

/// Index of the body with this name, for constants. An unknown name fails to compile.
pub(crate) const fn body(name: &str) -> usize {
    let mut index = 0;
    while index < BODIES {
        if same(table::BODIES[index].name, name) {
            return index;
        }
        index += 1;
    }
    panic!("no body of that name; found while compiling")
}

/// Index in [`JOINTS`] of the joint with this name, for constants. An unknown name fails to compile.
pub(crate) const fn joint(name: &str) -> usize {
    let mut index = 0;
    while index < JOINTS.len() {
        if same(JOINTS[index], name) {
            return index;
        }
        index += 1;
    }
    panic!("no joint of that name; found while compiling")
}

const fn same(a: &str, b: &str) -> bool {
    let (a, b) = (a.as_bytes(), b.as_bytes());
    if a.len() != b.len() {
        return false;
    }
    let mut index = 0;
    while index < a.len() {
        if a[index] != b[index] {
            return false;
        }
        index += 1;
    }
    true
}

/// The coordinate axis (0, 1 or 2) of a joint. The name of a joint ends in `rx`, `ry` or `rz`.
fn axis(joint: usize) -> usize {
    match JOINTS[joint].as_bytes().last() {
        Some(b'x') => 0,
        Some(b'y') => 1,
        _ => 2,
    }
}

/// Index of the body that carries this one; the first body carries itself.
pub(crate) fn parent(body: usize) -> usize {
    table::BODIES[body].parent
}

/// The joints of [`JOINTS`] that turn a body against its parent.
pub(crate) fn hinges(body: usize) -> std::ops::Range<usize> {
    let (first, end) = table::BODIES[body].hinges;
    first..end
}

pub(crate) fn geoms() -> &'static [Geom] {
    &table::GEOMS
}

impl Frames {
    /// Forward kinematics for the root at `position` (m) and `quaternion`, and the hinges at `joints` (rad, in the
    /// order of [`JOINTS`]). The order of operations is MuJoCo's (`mj_kinematics`), so quaternions get the same signs.
    pub(crate) fn of(position: &Vector, quaternion: &Quaternion, joints: &[f64; 56]) -> Self {
        let free = normalize(*quaternion);
        let mut frames = Self {
            position: [*position; BODIES],
            quaternion: [free; BODIES],
            rotation: [matrix(free); BODIES],
            axis: [[0.0; 3]; 56],
        };
        for (index, body) in table::BODIES.iter().enumerate().skip(1) {
            let mut at = add(frames.position[body.parent], rotate(&frames.rotation[body.parent], body.position));
            let mut turned = multiply(frames.quaternion[body.parent], body.quaternion);
            let (first, end) = body.hinges;
            for (hinge, angle) in joints.iter().enumerate().take(end).skip(first) {
                let before = matrix(turned);
                let axis = axis(hinge);
                frames.axis[hinge] = std::array::from_fn(|row| before[row][axis]);
                let anchor = add(at, rotate(&before, body.anchor));
                turned = multiply(turned, about(axis, *angle));
                at = subtract(anchor, rotate(&matrix(turned), body.anchor));
            }
            let turned = normalize(turned);
            frames.position[index] = at;
            frames.quaternion[index] = turned;
            frames.rotation[index] = matrix(turned);
        }
        frames
    }

    /// All angles zero, the root at the origin.
    pub(crate) fn zero() -> Self {
        Self::of(&[0.0; 3], &IDENTITY, &[0.0; 56])
    }

    /// Centre of mass of the whole body, m, world frame.
    pub(crate) fn center_of_mass(&self) -> Vector {
        let (mut moment, mut mass) = ([0.0; 3], 0.0);
        for (index, body) in table::BODIES.iter().enumerate() {
            let center = add(self.position[index], rotate(&self.rotation[index], body.center_of_mass));
            moment = add(moment, scale(body.mass, center));
            mass += body.mass;
        }
        scale(1.0 / mass, moment)
    }

    /// Height of the lowest point of a geom, m, world frame.
    pub(crate) fn bottom(&self, geom: &Geom) -> f64 {
        let [a, b] = self.low_points(geom);
        a[2].min(b[2])
    }

    /// The lowest point of each end of a capsule, m, world frame. A sphere or an ellipsoid has one lowest point, which is
    /// given twice.
    pub(crate) fn low_points(&self, geom: &Geom) -> [Vector; 2] {
        let rotation = &self.rotation[geom.body];
        let center = add(self.position[geom.body], rotate(rotation, geom.position));
        let local = matrix(geom.quaternion);
        // The columns of the geom's rotation are its axes in the world frame.
        let axes: Matrix = rotation.map(|row| unrotate(&local, row));
        // The world's z axis in the geom's frame.
        let up = axes[2];
        match geom.shape {
            Shape::Sphere { radius } => [subtract(center, [0.0, 0.0, radius]); 2],
            Shape::Capsule { radius, half_length } => {
                let middle = subtract(center, [0.0, 0.0, radius]);
                let half = scale(half_length, axes.map(|row| row[2]));
                [add(middle, half), subtract(middle, half)]
            }
            Shape::Ellipsoid { semi_axes } => {
                // The point of an ellipsoid with the semi-axes D farthest along the unit vector u is D² u / |D u|.
                let scaled: Vector = std::array::from_fn(|axis| semi_axes[axis] * up[axis]);
                let depth = norm(&scaled);
                let point: Vector = std::array::from_fn(|axis| semi_axes[axis] * scaled[axis] / depth);
                let [x, y, _] = subtract(center, rotate(&axes, point));
                [[x, y, center[2] - depth]; 2]
            }
        }
    }

    /// Height of the lowest point of all colliding geoms, m, world frame, and the geom that has it.
    pub(crate) fn lowest(&self) -> (f64, &'static Geom) {
        let mut lowest = (self.bottom(&table::GEOMS[0]), &table::GEOMS[0]);
        for geom in &table::GEOMS[1..] {
            let height = self.bottom(geom);
            if height < lowest.0 {
                lowest = (height, geom);
            }
        }
        lowest
    }
}
