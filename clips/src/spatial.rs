//! Vectors, rotations and quaternions (w x y z), as MuJoCo has them: right-handed, acting on columns.

pub(crate) type Vector = [f64; 3];
pub(crate) type Quaternion = [f64; 4];
/// Rows.
pub(crate) type Matrix = [[f64; 3]; 3];

pub(crate) const IDENTITY: Quaternion = [1.0, 0.0, 0.0, 0.0];

pub(crate) fn add(a: Vector, b: Vector) -> Vector {
    std::array::from_fn(|i| a[i] + b[i])
}

pub(crate) fn subtract(a: Vector, b: Vector) -> Vector {
    std::array::from_fn(|i| a[i] - b[i])
}

pub(crate) fn scale(factor: f64, a: Vector) -> Vector {
    a.map(|part| factor * part)
}

pub(crate) fn dot<const N: usize>(a: &[f64; N], b: &[f64; N]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

pub(crate) fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub(crate) fn norm<const N: usize>(a: &[f64; N]) -> f64 {
    dot(a, a).sqrt()
}

/// From the frame to the world.
pub(crate) fn rotate(rotation: &Matrix, vector: Vector) -> Vector {
    rotation.map(|row| dot(&row, &vector))
}

/// From the world to the frame.
pub(crate) fn unrotate(rotation: &Matrix, vector: Vector) -> Vector {
    std::array::from_fn(|column| (0..3).map(|row| rotation[row][column] * vector[row]).sum())
}

/// The rotation `a` after `b`.
pub(crate) fn multiply(a: Quaternion, b: Quaternion) -> Quaternion {
    let ([w, x, y, z], [bw, bx, by, bz]) = (a, b);
    [
        w * bw - x * bx - y * by - z * bz,
        w * bx + x * bw + y * bz - z * by,
        w * by - x * bz + y * bw + z * bx,
        w * bz + x * by - y * bx + z * bw,
    ]
}

pub(crate) fn conjugate([w, x, y, z]: Quaternion) -> Quaternion {
    [w, -x, -y, -z]
}

/// A rotation by `angle` (rad) about the coordinate axis `axis` (0, 1, 2).
pub(crate) fn about(axis: usize, angle: f64) -> Quaternion {
    let (sin, cos) = (angle / 2.0).sin_cos();
    let mut quaternion = [cos, 0.0, 0.0, 0.0];
    quaternion[1 + axis] = sin;
    quaternion
}

/// The unit quaternion along `quaternion`; the identity where that has no direction, as in MuJoCo.
pub(crate) fn normalize(quaternion: Quaternion) -> Quaternion {
    let length = norm(&quaternion);
    if length < 1e-15 { IDENTITY } else { quaternion.map(|part| part / length) }
}

/// `quaternion`, or its negative, which is the same rotation, on the side of `reference`.
pub(crate) fn aligned(quaternion: Quaternion, reference: &Quaternion) -> Quaternion {
    if dot(&quaternion, reference) < 0.0 { quaternion.map(|part| -part) } else { quaternion }
}

/// Of a unit quaternion.
pub(crate) fn matrix([w, x, y, z]: Quaternion) -> Matrix {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// The rotation from `a` to `b`, axis times angle in (−π, π], rad, in the frame of `a` (MuJoCo's `mj_quat2Vel`).
pub(crate) fn rotation_between(a: Quaternion, b: Quaternion) -> Vector {
    let [w, x, y, z] = multiply(conjugate(a), b);
    let sin = norm(&[x, y, z]);
    if sin < 1e-15 {
        return [0.0; 3];
    }
    let angle = 2.0 * sin.atan2(w);
    let shortest = if angle > std::f64::consts::PI { angle - std::f64::consts::TAU } else { angle };
    scale(shortest / sin, [x, y, z])
}
