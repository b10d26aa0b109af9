//! A symmetric system of linear equations.

/// Unknowns of a pose: position of the root (m), turn of the root about the world's axes (rad), joints (rad).
pub(super) const UNKNOWNS: usize = 62;

/// A symmetric matrix.
pub(super) type Square = Vec<[f64; UNKNOWNS]>;

/// Solves (A + `damping` I) x = `right` for the rows and columns of A in `free`, by Cholesky's method. A is positive
/// semidefinite; a pivot that rounding makes too small is raised.
pub(super) fn solve(matrix: &Square, free: &[usize], damping: f64, mut right: Vec<f64>) -> Vec<f64> {
    let count = free.len();
    let mut factor = vec![[0.0; UNKNOWNS]; count];
    for row in 0..count {
        let (above, rest) = factor.split_at_mut(row);
        let own = &mut rest[0];
        for column in 0..row {
            let other = &above[column];
            let known: f64 = own[..column].iter().zip(&other[..column]).map(|(a, b)| a * b).sum();
            own[column] = (matrix[free[row]][free[column]] - known) / other[column];
        }
        let known: f64 = own[..row].iter().map(|part| part * part).sum();
        own[row] = (matrix[free[row]][free[row]] + damping - known).max(1e-12).sqrt();
    }
    for row in 0..count {
        let known: f64 = (0..row).map(|column| factor[row][column] * right[column]).sum();
        right[row] = (right[row] - known) / factor[row][row];
    }
    for row in (0..count).rev() {
        let known: f64 = (row + 1..count).map(|below| factor[below][row] * right[below]).sum();
        right[row] = (right[row] - known) / factor[row][row];
    }
    right
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_solution_solves_the_chosen_equations() {
        let mut matrix: Square = vec![[0.0; UNKNOWNS]; UNKNOWNS];
        for (row, entries) in matrix.iter_mut().enumerate() {
            for (column, entry) in entries.iter_mut().enumerate() {
                *entry = 1.0 / (1.0 + row.abs_diff(column) as f64);
            }
            entries[row] += 3.0;
        }
        let free = [2, 3, 5, 40, 61];
        let right = vec![1.0, -2.0, 0.5, 3.0, -1.0];
        let solved = solve(&matrix, &free, 0.25, right.clone());
        for (row, right) in free.iter().zip(right) {
            let sum: f64 = free.iter().zip(&solved).map(|(column, part)| matrix[*row][*column] * part).sum();
            let own = free.iter().position(|unknown| unknown == row).unwrap();
            assert!((sum + 0.25 * solved[own] - right).abs() < 1e-12);
        }
    }
}
