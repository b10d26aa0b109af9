//! The comparison of a first pose that another machine's dm_control recorded.

use crate::npz::Values;
use crate::recording::{Rollout, committed, rollouts};
use crate::rules::{QUATERNION, compare_first_pose, compare_go_to_target, go_to_target, units_apart};

/// These tests are of the comparison, so they do not read rollouts of the user's own.
fn headings() -> Vec<Rollout> {
    let found = rollouts(&committed(), ("go_to_target_", "")).unwrap();
    assert!(!found.is_empty(), "{} has lost its go_to_target_*.npz", committed().display());
    found
}

fn set(rollout: &mut Rollout, name: &str, row: usize, numbers: &[f64]) {
    let array = rollout.arrays.get_mut(name).unwrap();
    let Values::Numbers(all) = &mut array.values else { panic!("{name} is text") };
    all[row * numbers.len()..][..numbers.len()].copy_from_slice(numbers);
}

fn pose(rollout: &Rollout) -> [f64; 63] {
    rollout.array("qpos").unwrap().row(0).unwrap().try_into().unwrap()
}

/// `number` moved by so many units in the last place, away from zero.
fn moved(number: f64, units: i64) -> f64 {
    f64::from_bits(number.to_bits().wrapping_add_signed(units))
}

/// The rollout with one coordinate of the first pose moved.
fn with_first(rollout: &Rollout, index: usize, units: i64) -> Rollout {
    let (mut copy, mut changed) = (rollout.clone(), pose(rollout));
    changed[index] = moved(changed[index], units);
    set(&mut copy, "qpos", 0, &changed);
    copy
}

#[test]
fn parity_allows_two_units_in_the_last_place_of_the_first_quaternion() {
    for rollout in headings() {
        for (index, units) in QUATERNION.flat_map(|index| [-2, -1, 0, 1, 2].map(|units| (index, units))) {
            let recorded = with_first(&rollout, index, units);
            assert_eq!(compare_first_pose(&recorded, &pose(&rollout)), Ok(&pose(&recorded)));
        }
    }
}

#[test]
fn parity_fails_where_the_first_quaternion_is_three_units_away() {
    for rollout in headings() {
        for (index, units) in QUATERNION.flat_map(|index| [-3, 3].map(|units| (index, units))) {
            let error = compare_first_pose(&with_first(&rollout, index, units), &pose(&rollout)).unwrap_err();
            let place = format!("{}: row 0: qpos[{index}]: ", rollout.file);
            assert!(error.starts_with(&place) && error.contains("3 units in the last place"), "{error}");
        }
    }
}

#[test]
fn parity_fails_where_another_coordinate_of_the_first_pose_is_one_unit_away() {
    for rollout in headings() {
        for index in (0..63).filter(|index| !QUATERNION.contains(index)) {
            let error = compare_first_pose(&with_first(&rollout, index, 1), &pose(&rollout)).unwrap_err();
            assert!(error.contains(&format!("row 0: qpos[{index}]: ")), "{error}");
        }
    }
}

#[test]
fn parity_counts_the_floats_between_two_numbers() {
    let least = f64::from_bits(1);
    let cases = [(1.0, 1.0, 0), (0.0, -0.0, 0), (-least, least, 2), (-1.0, -1f64.next_up(), 1)];
    for (one, other, units) in cases {
        assert_eq!((units_apart(one, other), units_apart(other, one)), (units, units));
    }
    assert!(units_apart(f64::NAN, 1.0) > 2 && units_apart(-1.0, 1.0) > 2);
}

/// The first three steps that dm_control would record on a machine whose BLAS rounds this component otherwise: our own
/// simulation from that pose. Quantities that are not set here change by less than their tolerance.
fn of_another_machine(rollout: &Rollout, index: usize, units: i64) -> Rollout {
    let mut recorded = with_first(rollout, index, units).head(3);
    let mut replay = go_to_target(rollout).unwrap();
    replay.begin_at(&pose(&recorded));
    set(&mut recorded, "qacc_warmstart_after_reset", 0, replay.simulation().qacc_warmstart());
    let controls: Vec<[f64; 56]> = recorded.controls().unwrap().into_iter().copied().collect();
    for (row, control) in (1..).zip(&controls) {
        replay.step_control(control);
        let (data, observations) = (replay.simulation(), replay.dictionary());
        for (name, numbers) in [
            ("qpos", data.qpos()),
            ("qvel", data.qvel()),
            ("act", data.act()),
            ("sensordata", data.sensordata()),
            ("obs", &observations.into_iter().flat_map(|(_, values)| values).collect::<Vec<f64>>()),
        ] {
            set(&mut recorded, name, row, numbers);
        }
    }
    recorded
}

#[test]
fn parity_goes_on_from_the_recorded_first_pose() {
    for rollout in headings() {
        for (index, units) in QUATERNION.flat_map(|index| [-2, 2].map(|units| (index, units))) {
            let recorded = of_another_machine(&rollout, index, units);
            let last = |rollout: &Rollout| rollout.array("qpos").unwrap().row(3).unwrap().to_vec();
            assert_ne!(last(&recorded), last(&rollout), "the last bits of the first pose have no effect");
            compare_go_to_target(&recorded).unwrap();
            // From there on every bit counts.
            let mut changed = last(&recorded);
            changed[3] = moved(changed[3], 1);
            let mut other = recorded.clone();
            set(&mut other, "qpos", 3, &changed);
            let error = compare_go_to_target(&other).unwrap_err();
            assert!(error.contains("row 3: qpos[3]: "), "{error}");
        }
    }
}
