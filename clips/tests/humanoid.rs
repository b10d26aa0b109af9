//! The tables of joints, and the map from pose to action.

mod support;

use comic_clips::{ACTUATOR_JOINTS, ACTUATORS, JOINT_RANGES, JOINTS, WalkerModel, pose_to_action};
use proptest::{array::uniform32, prelude::*};

#[test]
fn actuators_are_the_joints_in_alphabetical_order() {
    assert!(ACTUATORS.is_sorted());
    for (actuator, joint) in ACTUATORS.iter().zip(ACTUATOR_JOINTS) {
        assert_eq!(*actuator, JOINTS[joint]);
    }
    let mut places = ACTUATOR_JOINTS;
    places.sort_unstable();
    assert_eq!(places, std::array::from_fn(|i| i));
}

#[test]
fn v2020_has_one_body_more_than_v2019() {
    assert_eq!((WalkerModel::Cmu2019.bodies(), WalkerModel::Cmu2020.bodies()), (30, 31));
}

#[test]
fn ranges_equal_the_compiled_models() {
    let mut arrays = npyz::npz::NpzArchive::open(support::golden("models/tracking_model.npz")).unwrap();
    let ranges: Vec<f64> = arrays.by_name("jnt_range").unwrap().unwrap().into_vec().unwrap();
    // The free joint comes first.
    assert_eq!(JOINT_RANGES.as_flattened(), &ranges[2..]);
}

#[test]
fn the_ends_of_the_ranges_are_the_ends_of_the_actions() {
    let close = |actions: [f64; 56], expected: f64| actions.iter().all(|action| (action - expected).abs() < 1e-15);
    assert!(close(pose_to_action(&JOINT_RANGES.map(|[low, _]| low)), -1.0));
    assert!(close(pose_to_action(&JOINT_RANGES.map(|[low, high]| (low + high) / 2.0)), 0.0));
    assert!(close(pose_to_action(&JOINT_RANGES.map(|[_, high]| high)), 1.0));
}

proptest! {
    #![proptest_config(support::law())]

    #[test]
    fn an_action_is_within_bounds_and_its_servo_target_is_the_pose_clamped(
        first in uniform32(-4.0..4.0_f64),
        second in uniform32(-4.0..4.0_f64),
    ) {
        let pose: [f64; 56] = std::array::from_fn(|i| if i < 32 { first[i] } else { second[i - 32] });
        let action = pose_to_action(&pose);
        for (ctrl, joint) in ACTUATOR_JOINTS.into_iter().enumerate() {
            prop_assert!((-1.0..=1.0).contains(&action[ctrl]));
            let [low, high] = JOINT_RANGES[joint];
            let target = low + (action[ctrl] + 1.0) / 2.0 * (high - low);
            prop_assert!((target - pose[joint].clamp(low, high)).abs() < 1e-12);
        }
    }
}
