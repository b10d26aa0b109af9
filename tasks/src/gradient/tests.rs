//! What the tape keeps of a physics step. `tracking/gradient/tests.rs` compares the derivative with finite differences.

use comic_clips::WalkerModel;
use comic_clips::spatial::{about_vector, multiply};
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;

use super::dynamics::{Constraint, PhysicsStep, dot};
use super::*;
use crate::humanoid;
use crate::physics::Models;

/// A body that falls from the upright pose under these controls: `check` sees each physics step that is recorded.
pub(super) fn fall(control_steps: usize, amplitude: f64, mut check: impl FnMut(&GradientTape, &Data)) {
    let models = Models::new(humanoid::build(WalkerModel::Cmu2020).unwrap(), 6);
    let (mut data, mut random) = (models.data(), Pcg64::seed_from_u64(1));
    let mut tape = GradientTape::new(&models.shared(), 0.95).unwrap();
    let mut qpos = [0.0; 63];
    qpos[2] = 1.143;
    qpos[3..7].copy_from_slice(&comic_clips::spatial::normalize([0.859, 1.0, 1.0, 0.859]));
    models.place(&mut data, &qpos, &[0.0; VELOCITIES], None);
    for _ in 0..control_steps {
        let control = std::array::from_fn(|_| amplitude * random.random_range(-1.0..1.0));
        tape.begin_step(&control);
        models.step_and(&mut data, &control, |data| {
            let before = tape.recorded;
            tape.record(data);
            if tape.recorded > before {
                check(&tape, data);
            }
        });
    }
}

/// A state that is moved along one of its 62 positions, as velocities, or 62 velocities.
pub(crate) fn moved(qpos: &[f64], qvel: &[f64], index: usize, change: f64) -> (Vec<f64>, Vec<f64>) {
    let (mut qpos, mut qvel) = (qpos.to_vec(), qvel.to_vec());
    match index {
        0..3 => qpos[index] += change,
        // MuJoCo turns the root by velocities in its own frame.
        3..6 => {
            let axis = std::array::from_fn(|axis| f64::from(u8::from(axis == index - 3)));
            let turned = multiply([qpos[3], qpos[4], qpos[5], qpos[6]], about_vector(axis, change));
            qpos[3..7].copy_from_slice(&turned);
        }
        6..VELOCITIES => qpos[index + 1] += change,
        _ => qvel[index - VELOCITIES] += change,
    }
    (qpos, qvel)
}

pub(super) fn newest(tape: &GradientTape) -> &PhysicsStep {
    &tape.physics[tape.recorded - 1]
}

#[test]
fn the_factorised_dynamics_are_the_dense_ones_also_with_contacts_between_branches() {
    let (mut between, mut random) = (0, Pcg64::seed_from_u64(2));
    fall(60, 1.0, |tape, data| {
        let (step, constants) = (newest(tape), &tape.constants);
        let mut dense = vec![0.0; VELOCITIES * VELOCITIES];
        data.full_m(&mut dense).unwrap();
        for (index, damping) in constants.damping.iter().enumerate() {
            dense[index * (VELOCITIES + 1)] += constants.timestep * damping;
        }
        for Constraint { entries, weight, .. } in &step.constraints {
            let row = step.columns[entries.clone()].iter().zip(&step.values[entries.clone()]);
            for (column, value) in row.clone() {
                for (other, factor) in row.clone() {
                    dense[column * VELOCITIES + other] += weight * value * factor;
                }
            }
        }
        let wanted: [f64; VELOCITIES] = std::array::from_fn(|_| random.random_range(-1.0..1.0));
        let mut vector: [f64; VELOCITIES] =
            std::array::from_fn(|row| dot(&dense[row * VELOCITIES..][..VELOCITIES], &wanted));
        step.solve(constants, &mut vector);
        for (found, wanted) in vector.iter().zip(wanted) {
            assert!((found - wanted).abs() < 1e-6, "{found} is not {wanted}");
        }
        between += step.whitened.len();
    });
    assert!(between > 0, "no contact between branches was seen");
}
