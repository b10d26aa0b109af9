//! Vectors, rotation matrices and unit quaternions (w x y z) in MuJoCo's conventions: right-handed, acting on columns.
//!
//! A rotation matrix has two forms: [`Matrix`] for the kinematics of this crate, and [`FlatMatrix`] in the layout and with
//! the arithmetic of MuJoCo. The two formulas differ in the last bit, so neither replaces the other.

use std::f64::consts::{PI, TAU};

/// x, y, z.
pub type Vector = [f64; 3];
/// w, x, y, z.
pub type Quaternion = [f64; 4];
/// A rotation matrix as three rows.
pub type Matrix = [[f64; 3]; 3];
/// A rotation matrix, row after row: the layout of MuJoCo's `xmat`.
pub type FlatMatrix = [f64; 9];

/// No rotation.
pub const IDENTITY: Quaternion = [1.0, 0.0, 0.0, 0.0];

/// a + b.
pub fn add(a: Vector, b: Vector) -> Vector {
    std::array::from_fn(|i| a[i] + b[i])
}

/// a − b.
pub fn subtract(a: Vector, b: Vector) -> Vector {
    std::array::from_fn(|i| a[i] - b[i])
}

/// factor · a.
pub fn scale(factor: f64, a: Vector) -> Vector {
    a.map(|part| factor * part)
}

/// The dot product.
pub fn dot<const N: usize>(a: &[f64; N], b: &[f64; N]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// The cross product a × b.
pub fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// The Euclidean length.
pub fn norm<const N: usize>(a: &[f64; N]) -> f64 {
    dot(a, a).sqrt()
}

/// R v: from the frame to the world.
pub fn rotate(rotation: &Matrix, vector: Vector) -> Vector {
    rotation.map(|row| dot(&row, &vector))
}

/// Rᵀ v: from the world to the frame.
pub fn unrotate(rotation: &Matrix, vector: Vector) -> Vector {
    std::array::from_fn(|column| (0..3).map(|row| rotation[row][column] * vector[row]).sum())
}

/// Rᵀ v: from the world to the frame.
pub fn into_frame(rotation: &FlatMatrix, v: Vector) -> Vector {
    std::array::from_fn(|column| v[0] * rotation[column] + v[1] * rotation[3 + column] + v[2] * rotation[6 + column])
}

/// a ⊗ b: the rotation `a` after the rotation `b`.
pub fn multiply(a: Quaternion, b: Quaternion) -> Quaternion {
    let ([w, x, y, z], [bw, bx, by, bz]) = (a, b);
    [
        w * bw - x * bx - y * by - z * bz,
        w * bx + x * bw + y * bz - z * by,
        w * by - x * bz + y * bw + z * bx,
        w * bz + x * by - y * bx + z * bw,
    ]
}

/// The inverse of a unit quaternion.
pub fn conjugate([w, x, y, z]: Quaternion) -> Quaternion {
    [w, -x, -y, -z]
}

/// conj(a) ⊗ b: the orientation `b` in the frame of `a`.
pub fn relative(a: Quaternion, b: Quaternion) -> Quaternion {
    multiply(conjugate(a), b)
}

/// A rotation by `angle` (rad) about the coordinate axis `axis` (0, 1, 2).
pub fn about(axis: usize, angle: f64) -> Quaternion {
    let (sin, cos) = (angle / 2.0).sin_cos();
    let mut quaternion = [cos, 0.0, 0.0, 0.0];
    quaternion[1 + axis] = sin;
    quaternion
}

/// A rotation by `angle` (rad) about the unit vector `axis`.
pub fn about_vector(axis: Vector, angle: f64) -> Quaternion {
    let (sin, cos) = (angle / 2.0).sin_cos();
    [cos, axis[0] * sin, axis[1] * sin, axis[2] * sin]
}

/// `quaternion` divided by its length; the identity when the length is 0, as in MuJoCo.
pub fn normalize(quaternion: Quaternion) -> Quaternion {
    let length = norm(&quaternion);
    if length < 1e-15 { IDENTITY } else { quaternion.map(|part| part / length) }
}

/// `quaternion` or its negative, which is the same rotation: the one nearer to `reference`.
pub fn aligned(quaternion: Quaternion, reference: &Quaternion) -> Quaternion {
    if dot(&quaternion, reference) < 0.0 { quaternion.map(|part| -part) } else { quaternion }
}

/// The rotation matrix of a unit quaternion.
pub fn matrix([w, x, y, z]: Quaternion) -> Matrix {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// The rotation matrix of a unit quaternion (MuJoCo's `mju_quat2Mat`).
pub fn flat_matrix([w, x, y, z]: Quaternion) -> FlatMatrix {
    [
        w * w + x * x - y * y - z * z,
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        w * w - x * x + y * y - z * z,
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        w * w - x * x - y * y + z * z,
    ]
}

/// `v` rotated by a unit quaternion.
pub fn rotated(quaternion: Quaternion, v: Vector) -> Vector {
    let rotation = flat_matrix(quaternion);
    std::array::from_fn(|row| (0..3).map(|column| rotation[3 * row + column] * v[column]).sum())
}

/// The rotation from `a` to `b`, axis times angle in (−π, π], rad, in the frame of `a` (MuJoCo's `mj_quat2Vel`).
pub fn rotation_between(a: Quaternion, b: Quaternion) -> Vector {
    let [w, x, y, z] = multiply(conjugate(a), b);
    let sin = norm(&[x, y, z]);
    if sin < 1e-15 {
        return [0.0; 3];
    }
    let angle = 2.0 * sin.atan2(w);
    let shortest = if angle > PI { angle - TAU } else { angle };
    scale(shortest / sin, [x, y, z])
}

/// Axis times angle of a unit quaternion, the angle in [−π, π), rad (dm_control's
/// `utils/transformations.quat_to_axisangle`).
pub fn axis_angle(quaternion: Quaternion) -> Vector {
    let [w, x, y, z] = quaternion;
    let angle = 2.0 * w.clamp(-1.0, 1.0).acos();
    if angle < 1e-10 {
        return [0.0; 3];
    }
    let sin = (angle / 2.0).sin();
    let wrapped = (angle + PI).rem_euclid(TAU) - PI;
    [x, y, z].map(|part| part / sin * wrapped)
}

/// Half the angle between two orientations, 0 … π/2 rad. It does not depend on the signs or lengths of the quaternions
/// (dm_control's `reference_pose/rewards.bounded_quat_dist`).
pub fn half_angle_between(a: Quaternion, b: Quaternion) -> f64 {
    let dot = dot(&normalize(a), &normalize(b));
    // The cosine can be larger than 1 by rounding.
    0.5 * (2.0 * dot * dot - 1.0).min(1.0).acos()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn unit() -> impl Strategy<Value = Quaternion> {
        prop::array::uniform4(-1.0..1.0f64).prop_filter("not too short", |q| dot(q, q) > 1e-2).prop_map(normalize)
    }

    fn vector() -> impl Strategy<Value = Vector> {
        prop::array::uniform3(-5.0..5.0f64)
    }

    fn near(a: &[f64], b: &[f64]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-10)
    }

    proptest! {
        #[test]
        fn an_orientation_relative_to_itself_is_the_identity(q in unit()) {
            prop_assert!(near(&relative(q, q), &IDENTITY));
        }

        #[test]
        fn the_angle_ignores_sign_and_length(a in unit(), b in unit(), scale in 0.1..10.0f64) {
            let other = b.map(|x| -x * scale);
            prop_assert!((half_angle_between(a, b) - half_angle_between(a, other)).abs() < 1e-7);
        }

        #[test]
        fn changing_the_frame_keeps_lengths(q in unit(), v in vector()) {
            prop_assert!((norm(&into_frame(&flat_matrix(q), v)) - norm(&v)).abs() < 1e-10);
        }

        #[test]
        fn both_forms_of_a_matrix_are_the_same_rotation(q in unit(), v in vector()) {
            prop_assert!(near(&flat_matrix(q), matrix(q).as_flattened()));
            prop_assert!(near(&rotated(q, v), &rotate(&matrix(q), v)));
            prop_assert!(near(&into_frame(&flat_matrix(q), v), &unrotate(&matrix(q), v)));
        }

        #[test]
        fn axis_and_angle_give_the_quaternion_back(q in unit()) {
            let turn = axis_angle(q);
            let angle = norm(&turn);
            prop_assume!(angle > 1e-6);
            let back = about_vector(scale(1.0 / angle, turn), angle);
            prop_assert!(half_angle_between(q, back) < 1e-6);
        }
    }
}
