//! Quaternions (w x y z) and rotation matrices (row-major), with the operations the task needs.

/// conj(a) ⊗ b: b as seen from a.
pub(crate) fn relative(a: &[f64; 4], b: &[f64; 4]) -> [f64; 4] {
    let [aw, ax, ay, az] = [a[0], -a[1], -a[2], -a[3]];
    let [bw, bx, by, bz] = *b;
    [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
}

/// a ⊗ b: b turned by a.
pub(crate) fn product(a: &[f64; 4], b: &[f64; 4]) -> [f64; 4] {
    relative(&[a[0], -a[1], -a[2], -a[3]], b)
}

/// The turn by `angle` (rad) about the unit vector `axis`.
pub(crate) fn turn(axis: [f64; 3], angle: f64) -> [f64; 4] {
    let (sine, cosine) = (angle / 2.0).sin_cos();
    [cosine, axis[0] * sine, axis[1] * sine, axis[2] * sine]
}

/// v turned by a unit quaternion.
pub(crate) fn rotated(q: &[f64; 4], v: [f64; 3]) -> [f64; 3] {
    let rotation = matrix(q);
    std::array::from_fn(|row| (0..3).map(|column| rotation[3 * row + column] * v[column]).sum())
}

/// The quaternion divided by its length.
pub(crate) fn normalised(q: &[f64; 4]) -> [f64; 4] {
    let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    q.map(|x| x / length)
}

/// The rotation matrix of a unit quaternion.
pub(crate) fn matrix(q: &[f64; 4]) -> [f64; 9] {
    let [w, x, y, z] = *q;
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

/// Rᵀ v: a world vector in the frame whose orientation is R.
pub(crate) fn into_frame(rotation: &[f64; 9], v: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|column| v[0] * rotation[column] + v[1] * rotation[3 + column] + v[2] * rotation[6 + column])
}

/// a − b.
pub(crate) fn difference(a: &[f64; 3], b: &[f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i] - b[i])
}

/// Axis times angle (rad) of a unit quaternion, the angle in [−π, π) (`utils/transformations.quat_to_axisangle`).
pub(crate) fn axis_angle(q: &[f64; 4]) -> [f64; 3] {
    use std::f64::consts::{PI, TAU};
    let angle = 2.0 * q[0].clamp(-1.0, 1.0).acos();
    if angle < 1e-10 {
        return [0.0; 3];
    }
    let sine = (angle / 2.0).sin();
    let wrapped = (angle + PI).rem_euclid(TAU) - PI;
    [q[1], q[2], q[3]].map(|x| x / sine * wrapped)
}

/// Half the angle between two orientations (rad, 0 … π/2), blind to a quaternion's sign and length
/// (`reference_pose/rewards.bounded_quat_dist`).
pub(crate) fn distance(a: &[f64; 4], b: &[f64; 4]) -> f64 {
    let (a, b) = (normalised(a), normalised(b));
    let dot: f64 = a.iter().zip(b).map(|(x, y)| x * y).sum();
    // Rounding may carry the cosine beyond 1.
    0.5 * (2.0 * dot * dot - 1.0).min(1.0).acos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn unit() -> impl Strategy<Value = [f64; 4]> {
        prop::array::uniform4(-1.0..1.0f64)
            .prop_filter("not too short", |q| q.iter().map(|x| x * x).sum::<f64>() > 1e-2)
            .prop_map(|q| normalised(&q))
    }

    proptest! {
        #[test]
        fn an_orientation_seen_from_itself_is_the_identity(q in unit()) {
            let identity = relative(&q, &q);
            prop_assert!((identity[0] - 1.0).abs() < 1e-12);
            prop_assert!(identity[1..].iter().all(|x| x.abs() < 1e-12));
        }

        #[test]
        fn the_distance_ignores_sign_and_length(a in unit(), b in unit(), scale in 0.1..10.0f64) {
            let other = b.map(|x| -x * scale);
            prop_assert!((distance(&a, &b) - distance(&a, &other)).abs() < 1e-7);
        }

        #[test]
        fn rotating_keeps_lengths(q in unit(), v in prop::array::uniform3(-5.0..5.0f64)) {
            let turned = into_frame(&matrix(&q), v);
            let length = |v: &[f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
            prop_assert!((length(&turned) - length(&v)).abs() < 1e-10);
        }

        #[test]
        fn axis_and_angle_give_the_quaternion_back(q in unit()) {
            let turn = axis_angle(&q);
            let angle = turn.iter().map(|x| x * x).sum::<f64>().sqrt();
            prop_assume!(angle > 1e-6);
            let mut back = [(angle / 2.0).cos(), 0.0, 0.0, 0.0];
            for i in 0..3 {
                back[i + 1] = turn[i] / angle * (angle / 2.0).sin();
            }
            prop_assert!(distance(&q, &back) < 1e-6);
        }
    }
}
