//! The dynamics of a physics step, linearised and factorised.

use std::ops::Range;

use mujoco_rs::mujoco_c::mjtDisableBit;
use mujoco_rs::prelude::*;

use super::constraints::active_constraints;
use super::{ACTIONS, VELOCITIES};
use crate::error::Error;
use crate::humanoid::walker::{ROOT_VELOCITIES, Walker};
use crate::physics::Data;

/// The parts of the model that no step changes.
#[derive(Clone, Debug)]
pub(super) struct Constants {
    /// Length of a physics step, s.
    pub(super) timestep: f64,
    /// Of each velocity: damping, and stiffness of the joint and of its servo.
    pub(super) damping: [f64; VELOCITIES],
    pub(super) stiffness: [f64; VELOCITIES],
    /// Of each servo: torque for a filter state of 1, and the share of the control that the filter takes in a physics step.
    pub(super) gain: [f64; ACTIONS],
    pub(super) share: f64,
    /// Where each row of the inertia's lower triangle is among its entries. A row has an entry for each velocity that its own
    /// depends on, from the root to itself, which is last.
    pub(super) rows: [Range<usize>; VELOCITIES],
    /// The velocity of each entry.
    pub(super) columns: Vec<usize>,
}

/// The dynamics of a physics step: H = M + h·damping + Jᵀ D J, factorised, for the inertia M and the Jacobian J of the active
/// constraints.
///
/// A constraint along one branch of the body, as a joint's limit or a contact with the ground, adds to entries that M has
/// already. So the part of H with all of these is Lᵀ Λ L for an L as sparse as the tree of joints. Only contacts between two
/// branches, as of a hand with a thigh, are left, and there are few. With W = Λ^-½ L^-T Jᵀ of these and S = D⁻¹ + Wᵀ W,
/// Woodbury's formula says that H⁻¹ = L⁻¹ Λ^-½ (1 − W S⁻¹ Wᵀ) Λ^-½ L^-T.
#[derive(Debug, Default)]
pub(super) struct PhysicsStep {
    /// L, with Λ^-½ on the diagonal, in the order of `Constants::columns`.
    pub(super) factor: Vec<f64>,
    /// The active constraints, and the entries of their rows of J that are not 0: velocities and values.
    pub(super) constraints: Vec<Constraint>,
    pub(super) columns: Vec<usize>,
    pub(super) values: Vec<f64>,
    /// W, `[n, 62]`, and the Cholesky factor of S, `[n, n]`, for the n constraints between two branches.
    pub(super) whitened: Vec<[f64; VELOCITIES]>,
    pub(super) small: Vec<f64>,
}

/// A row of J.
#[derive(Debug)]
pub(super) struct Constraint {
    pub(super) entries: Range<usize>,
    /// D, and D times the stiffness with the impedance, and times the damping.
    pub(super) weight: f64,
    pub(super) stiffness: f64,
    pub(super) damping: f64,
}

impl PhysicsStep {
    pub(super) fn read(&mut self, constants: &Constants, data: &Data) {
        let Self { factor, constraints, columns, values, whitened, small } = self;
        factor.clear();
        factor.extend_from_slice(data.m());
        for (row, damping) in constants.rows.iter().zip(constants.damping) {
            factor[row.end - 1] += constants.timestep * damping;
        }
        constraints.clear();
        columns.clear();
        values.clear();
        let mut between = Vec::new();
        active_constraints(data, |row| {
            let (start, weight) = (columns.len(), row.weight);
            columns.extend(row.columns.iter().map(|column| *column as usize));
            values.extend_from_slice(row.values);
            let entries = start..columns.len();
            if !constants.add_along_branch(factor, &columns[start..], &values[start..], weight) {
                between.push(constraints.len());
            }
            let (stiffness, damping) = (weight * row.stiffness, weight * row.damping);
            constraints.push(Constraint { entries, weight, stiffness, damping });
        });
        constants.factorise(factor);
        let n = between.len();
        whitened.clear();
        small.clear();
        small.resize(n * n, 0.0);
        for (index, constraint) in between.into_iter().enumerate() {
            let Constraint { entries, weight, .. } = &constraints[constraint];
            let mut row = [0.0; VELOCITIES];
            for (column, value) in columns[entries.clone()].iter().zip(&values[entries.clone()]) {
                row[*column] = *value;
            }
            constants.divide_by_transpose(factor, &mut row);
            whitened.push(row);
            for (other, place) in whitened.iter().zip(small.iter_mut().skip(index).step_by(n)) {
                *place = dot(&row, other);
            }
            small[index * (n + 1)] += 1.0 / weight;
        }
        cholesky(small, n);
    }

    /// Multiplies by H⁻¹ from the left.
    pub(super) fn solve(&self, constants: &Constants, vector: &mut [f64; VELOCITIES]) {
        constants.divide_by_transpose(&self.factor, vector);
        if !self.whitened.is_empty() {
            let mut forces: Vec<f64> = self.whitened.iter().map(|row| dot(row, vector)).collect();
            cholesky_solve(&self.small, &mut forces);
            for (row, force) in self.whitened.iter().zip(forces) {
                add_scaled(vector, -force, row);
            }
        }
        constants.divide(&self.factor, vector);
    }
}

impl Constants {
    pub(super) fn new(model: &MjModel) -> Result<Self, Error> {
        // The arrays of columns that `record` reads exist only with sparse constraints.
        let options = model.opt();
        let implicit = options.integrator == MjtIntegrator::mjINT_EULER as i32
            && options.disableflags & mjtDisableBit::mjDSBL_EULERDAMP as i32 == 0;
        let fits = model.na() == ACTIONS as i64 && model.nv() == VELOCITIES as i64;
        if !(fits && implicit && model.is_sparse()) {
            return Err(Error::NoDerivative);
        }
        let timestep = options.timestep;
        let (mut damping, mut stiffness) = ([0.0; VELOCITIES], [0.0; VELOCITIES]);
        damping.copy_from_slice(&model.dof_damping()[..VELOCITIES]);
        for (index, place) in stiffness.iter_mut().enumerate().skip(ROOT_VELOCITIES) {
            *place = model.jnt_stiffness()[model.dof_jntid()[index] as usize];
        }
        let mut gain = [0.0; ACTIONS];
        for (servo, joint) in Walker::servo_joints().into_iter().enumerate() {
            gain[servo] = model.actuator_gainprm()[servo][0];
            stiffness[ROOT_VELOCITIES + joint] -= model.actuator_biasprm()[servo][1];
        }
        let share = timestep / model.actuator_dynprm()[0][0];
        let rows: [Range<usize>; VELOCITIES] = std::array::from_fn(|row| {
            let start = model.m_rowadr()[row] as usize;
            start..start + model.m_rownnz()[row] as usize
        });
        let columns: Vec<usize> = model.m_colind().iter().map(|column| *column as usize).collect();
        // The formulas need whole branches: a row's velocities begin with those of each of them.
        let branch = |row: usize| columns.get(Range::clone(&rows[row])).unwrap_or_default();
        let whole = |row: usize| {
            branch(row).last() == Some(&row)
                && branch(row).iter().all(|column| branch(row).starts_with(branch(*column)))
        };
        if !(0..VELOCITIES).all(whole) {
            return Err(Error::NoDerivative);
        }
        Ok(Self { timestep, damping, stiffness, gain, share, rows, columns })
    }

    /// Adds D Jᵀ J of one row of J to the matrix, if all velocities of the row are along one branch of the body.
    fn add_along_branch(&self, matrix: &mut [f64], columns: &[usize], values: &[f64], weight: f64) -> bool {
        let Some(last) = columns.iter().max() else { return true };
        let branch = &self.columns[self.rows[*last].clone()];
        let mut along = [0.0; VELOCITIES];
        let along = &mut along[..branch.len()];
        for (column, value) in columns.iter().zip(values) {
            // The columns of a branch ascend.
            match branch.binary_search(column) {
                Ok(place) => along[place] = *value,
                Err(_) => return false,
            }
        }
        // The branch up to one of its velocities is that velocity's own.
        for (place, column) in branch.iter().enumerate() {
            if along[place] != 0.0 {
                add_scaled(&mut matrix[self.rows[*column].clone()], weight * along[place], along);
            }
        }
        true
    }

    /// Replaces the lower triangle of a positive definite matrix by L, with Λ^-½ on the diagonal, so that it is Lᵀ Λ L.
    fn factorise(&self, matrix: &mut [f64]) {
        for row in (0..VELOCITIES).rev() {
            let (above, own) = matrix.split_at_mut(self.rows[row].start);
            let length = self.rows[row].len() - 1;
            let inverse = 1.0 / own[length];
            let branch = &self.columns[self.rows[row].clone()][..length];
            for (place, column) in branch.iter().enumerate().rev() {
                add_scaled(&mut above[self.rows[*column].clone()], -own[place] * inverse, own);
            }
            own[..length].iter_mut().for_each(|value| *value *= inverse);
            own[length] = inverse.sqrt();
        }
    }

    /// Multiplies by Λ^-½ L^-T from the left. An entry that is 0 costs nothing.
    fn divide_by_transpose(&self, factor: &[f64], vector: &mut [f64; VELOCITIES]) {
        for row in (0..VELOCITIES).rev() {
            let (value, length) = (vector[row], self.rows[row].len() - 1);
            if value != 0.0 {
                let (columns, entries) = (&self.columns[self.rows[row].clone()], &factor[self.rows[row].clone()]);
                for (column, entry) in columns[..length].iter().zip(entries) {
                    vector[*column] -= entry * value;
                }
                vector[row] = value * entries[length];
            }
        }
    }

    /// Multiplies by L⁻¹ Λ^-½ from the left.
    fn divide(&self, factor: &[f64], vector: &mut [f64; VELOCITIES]) {
        for row in 0..VELOCITIES {
            let (columns, entries) = (&self.columns[self.rows[row].clone()], &factor[self.rows[row].clone()]);
            let length = entries.len() - 1;
            let sum: f64 = columns[..length].iter().zip(entries).map(|(column, entry)| entry * vector[*column]).sum();
            vector[row] = vector[row] * entries[length] - sum;
        }
    }
}

/// Cholesky: replaces the upper triangle of a positive definite `[n, n]` by U with Uᵀ U equal to it, with the inverse of U's
/// diagonal.
fn cholesky(matrix: &mut [f64], n: usize) {
    for k in 0..n {
        let (above, below) = matrix.split_at_mut((k + 1) * n);
        let pivot = &mut above[k * n + k..];
        let inverse = 1.0 / pivot[0].sqrt();
        pivot[0] = inverse;
        pivot[1..].iter_mut().for_each(|value| *value *= inverse);
        for (row, rest) in (k + 1..n).zip(below.chunks_exact_mut(n)) {
            let own = &pivot[row - k..];
            add_scaled(&mut rest[row..], -own[0], own);
        }
    }
}

/// (Uᵀ U)⁻¹ times the vector, for U from [`cholesky`].
fn cholesky_solve(matrix: &[f64], vector: &mut [f64]) {
    let n = vector.len();
    for k in 0..n {
        let row = &matrix[k * n + k..(k + 1) * n];
        let value = vector[k] * row[0];
        vector[k] = value;
        add_scaled(&mut vector[k + 1..], -value, &row[1..]);
    }
    for k in (0..n).rev() {
        let row = &matrix[k * n + k..(k + 1) * n];
        vector[k] = (vector[k] - dot(&row[1..], &vector[k + 1..])) * row[0];
    }
}

fn add_scaled(sum: &mut [f64], factor: f64, other: &[f64]) {
    for (sum, other) in sum.iter_mut().zip(other) {
        *sum += factor * other;
    }
}

pub(super) fn dot(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(one, other)| one * other).sum()
}
