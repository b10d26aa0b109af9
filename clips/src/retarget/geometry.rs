//! Directions and rotation matrices.

use crate::spatial::{Matrix, Vector, about_vector, cross, dot, matrix, norm, scale, subtract};

/// The vector with length 1; near 0 for a vector without length.
pub(super) fn unit(vector: Vector) -> Vector {
    scale(1.0 / norm(&vector).max(1e-12), vector)
}

/// The angle between two vectors, rad.
pub(super) fn angle(a: Vector, b: Vector) -> f64 {
    norm(&cross(a, b)).atan2(dot(&a, &b))
}

/// The part of a vector that is perpendicular to a unit vector.
pub(super) fn across(vector: Vector, axis: Vector) -> Vector {
    subtract(vector, scale(dot(&vector, &axis), axis))
}

/// A rotation matrix whose second column is along `y`, and whose first column is along `x` as far as that allows.
pub(super) fn frame(x: Vector, y: Vector) -> Matrix {
    let y = unit(y);
    let x = unit(across(x, y));
    from_columns([x, y, cross(x, y)])
}

pub(super) fn from_columns(columns: [Vector; 3]) -> Matrix {
    std::array::from_fn(|row| columns.map(|column| column[row]))
}

pub(super) fn column(rotation: &Matrix, index: usize) -> Vector {
    rotation.map(|row| row[index])
}

/// a b.
pub(super) fn product(a: &Matrix, b: &Matrix) -> Matrix {
    std::array::from_fn(|row| std::array::from_fn(|column| (0..3).map(|k| a[row][k] * b[k][column]).sum()))
}

pub(super) fn transposed(a: &Matrix) -> Matrix {
    std::array::from_fn(|row| column(a, row))
}

/// The least rotation from one unit vector to another.
pub(super) fn between(from: Vector, to: Vector) -> Matrix {
    let axis = cross(from, to);
    let sine = norm(&axis);
    let axis = match sine > 1e-9 {
        true => unit(axis),
        // Any axis across opposite vectors.
        false => unit(if from[0].abs() < 0.7 { cross(from, [1.0, 0.0, 0.0]) } else { cross(from, [0.0, 1.0, 0.0]) }),
    };
    matrix(about_vector(axis, sine.atan2(dot(&from, &to))))
}
