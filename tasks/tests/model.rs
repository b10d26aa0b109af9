//! Facts of the compiled humanoid. `parity/model.rs` compares every array with dm_control's.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

use comic_clips::{ACTUATOR_JOINTS, ACTUATORS, JOINT_RANGES, JOINTS, WalkerModel};
use comic_tasks::humanoid::{PREFIX, build};
use mujoco_rs::prelude::*;

#[test]
fn the_2020_body_has_its_sizes() {
    let model = build(WalkerModel::Cmu2020).unwrap();
    let sizes = [model.nq(), model.nv(), model.nu(), model.na(), model.nbody(), model.njnt(), model.ngeom()];
    assert_eq!(sizes, [63, 62, 56, 56, 34, 57, 48]);
    let sizes = [model.nsite(), model.ncam(), model.nsensor(), model.nsensordata(), model.nexclude(), model.ntex()];
    assert_eq!(sizes, [14, 6, 19, 37, 5, 1]);
    assert_eq!((model.nmat(), model.nmesh()), (2, 0));
}

#[test]
fn the_2019_body_has_no_filter_and_no_face() {
    let model = build(WalkerModel::Cmu2019).unwrap();
    assert_eq!([model.nq(), model.nv(), model.nu(), model.na()], [63, 62, 56, 0]);
    assert_eq!([model.nbody(), model.ngeom()], [33, 44]);
}

#[test]
fn the_2020_body_weighs_seventy_kilograms() {
    let model = build(WalkerModel::Cmu2020).unwrap();
    let mass: f64 = model.body_mass().iter().sum();
    // Two massless bodies get the smallest mass that the model allows, 1e-5 kg each.
    assert!((mass - 70.00002).abs() < 1e-9, "{mass}");
}

#[test]
fn options_are_dm_controls() {
    let model = build(WalkerModel::Cmu2020).unwrap();
    let option = model.opt();
    assert_eq!(option.timestep, 0.005);
    assert_eq!((option.noslip_iterations, option.noslip_tolerance), (5, 0.0));
    assert_eq!((option.disableflags, option.enableflags), (0, 0));
}

#[test]
fn joints_and_servos_have_the_order_of_the_clips() {
    let model = build(WalkerModel::Cmu2020).unwrap();
    for (index, joint) in JOINTS.iter().enumerate() {
        // Joint 0 is the root's.
        assert_eq!(model.id_to_name(MjtObjBase::mjOBJ_JOINT, 1 + index), Some(format!("{PREFIX}{joint}").as_str()));
        assert_eq!(model.jnt_range()[1 + index], JOINT_RANGES[index], "{joint}");
    }
    for (servo, (name, joint)) in ACTUATORS.iter().zip(ACTUATOR_JOINTS).enumerate() {
        assert_eq!(model.id_to_name(MjtObjBase::mjOBJ_ACTUATOR, servo), Some(format!("{PREFIX}{name}").as_str()));
        assert_eq!(model.actuator_trnid()[servo][0], 1 + joint as i32, "{name}");
    }
}

#[test]
fn a_servos_target_is_linear_in_its_action_over_the_joints_range() {
    let model = build(WalkerModel::Cmu2020).unwrap();
    for (servo, joint) in ACTUATOR_JOINTS.into_iter().enumerate() {
        let (gain, bias) = (model.actuator_gainprm()[servo][0], model.actuator_biasprm()[servo]);
        let stiffness = -bias[1];
        let [low, high] = JOINT_RANGES[joint];
        assert!(((bias[0] - gain) / stiffness - low).abs() < 1e-12, "{}", ACTUATORS[servo]);
        assert!(((bias[0] + gain) / stiffness - high).abs() < 1e-12, "{}", ACTUATORS[servo]);
        assert_eq!(model.actuator_forcerange()[servo], [-stiffness, stiffness], "{}", ACTUATORS[servo]);
        assert_eq!(model.actuator_dynprm()[servo][0], 0.03, "{}", ACTUATORS[servo]);
    }
}
