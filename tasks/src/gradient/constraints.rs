//! Which constraints are active.

use mujoco_rs::prelude::*;

use crate::physics::Data;

/// A row of the constraints' Jacobian J.
pub(super) struct Row<'a> {
    /// The entries that are not 0.
    pub(super) columns: &'a [i32],
    pub(super) values: &'a [f64],
    /// D: force for an acceleration.
    pub(super) weight: f64,
    /// Of the reference acceleration: for a distance, with the impedance, and for a velocity.
    pub(super) stiffness: f64,
    pub(super) damping: f64,
}

/// Calls `take` with each row that resists a motion. The constraints are sparse, and a step has just ended.
///
/// Contacts are told by their forces. The arena has a no-slip pass, after which MuJoCo 3.17.0 leaves the state of an elliptic
/// contact whose force is inside its cone at "satisfied". So by its states no contact sticks. A contact that slides, at the
/// edge of its friction cone, resists only along its normal, its first row.
#[allow(unsafe_code)]
pub(super) fn active_constraints(data: &Data, mut take: impl FnMut(Row<'_>)) {
    // SAFETY: MuJoCo wrote these arrays in the step that has just ended.
    let (states, forces, parameters, weights) =
        unsafe { (data.efc_state(), data.efc_force(), data.efc_kbip(), data.efc_d()) };
    // SAFETY: as above, and the constraints are sparse.
    let (counts, starts, columns) = unsafe { (data.efc_j_rownnz(), data.efc_j_rowadr(), data.efc_j_colind()) };
    let mut take = |row: usize| {
        let place = starts[row] as usize..starts[row] as usize + counts[row] as usize;
        let [stiffness, damping, impedance, _] = parameters[row];
        let (columns, values) = (&columns[place.clone()], &data.efc_j()[place]);
        take(Row { columns, values, weight: weights[row], stiffness: stiffness * impedance, damping });
    };
    let (types, objects, contacts) = (data.efc_type(), data.efc_id(), data.contact());
    let mut row = 0;
    while row < types.len() {
        let contact = match types[row] {
            MjtConstraint::mjCNSTR_CONTACT_ELLIPTIC => contacts.get(objects[row] as usize),
            _ => None,
        };
        let Some(contact) = contact else {
            if states[row] == MjtConstraintState::mjCNSTRSTATE_QUADRATIC {
                take(row);
            }
            row += 1;
            continue;
        };
        let rows = row..row + (contact.dim as usize).max(1);
        let (normal, tangential) = (forces[row], &forces[row + 1..rows.end]);
        if normal > 0.0 {
            let ratios = tangential.iter().zip(contact.friction).map(|(force, friction)| force / friction);
            let slides = ratios.map(|ratio| ratio * ratio).sum::<f64>() >= normal * normal * (1.0 - EDGE);
            (if slides { row..row + 1 } else { rows.clone() }).for_each(&mut take);
        }
        row = rows.end;
    }
}

/// A contact this close to its cone's edge slides, as a share of its squared force (D): the no-slip pass puts the force on
/// the edge up to rounding.
const EDGE: f64 = 1e-6;

#[cfg(test)]
mod tests {
    use super::super::tests::{fall, newest};
    use super::*;

    #[test]
    #[allow(unsafe_code)]
    fn a_standing_body_holds_its_contacts_although_by_mujocos_states_none_sticks() {
        let mut tangential = 0;
        fall(4, 0.0, |tape, data| {
            // SAFETY: MuJoCo wrote this array in the step that has just ended.
            let states = unsafe { data.efc_state() };
            for contact in data.contact() {
                let rows = contact.efc_address as usize..(contact.efc_address + contact.dim) as usize;
                let sticks = MjtConstraintState::mjCNSTRSTATE_QUADRATIC;
                assert!(states[rows].iter().all(|state| *state != sticks), "MuJoCo has changed: ask it for the states");
            }
            // Only friction has no stiffness.
            let friction = newest(tape).constraints.iter().filter(|constraint| constraint.stiffness == 0.0);
            tangential += friction.count();
        });
        assert!(tangential > 0, "no contact sticks");
    }
}
