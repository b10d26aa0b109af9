//! Termination error and reward (`reference_pose/tracking.py`, `reference_pose/rewards.py`: `comic_reward_fn`).

use comic_clips::spatial::half_angle_between;
use comic_experiment::TerminationError;

use super::reference::Reference;
use crate::environment::MAX_REWARD_TERMS;
use crate::humanoid::features::appendages;
use crate::humanoid::walker::{ROOT_COORDINATES, ROOT_VELOCITIES, Walker};
use crate::physics::Data;

/// ε: the difference between the body and frame `frame`, in the positions of the tracking bodies (m, world) and the joint
/// angles (rad).
pub(crate) fn termination_error(
    kind: TerminationError,
    walker: &Walker,
    data: &Data,
    reference: &Reference,
    frame: usize,
) -> f64 {
    let bodies = data.xpos()[walker.tracked.clone()].as_flattened();
    let joints = &data.qpos()[ROOT_COORDINATES..];
    let (body_sum, joint_sum) =
        (absolute(bodies, reference.body_positions(frame)), absolute(joints, reference.joints(frame)));
    match kind {
        TerminationError::DmControl => 0.5 * (body_sum / bodies.len() as f64) + 0.5 * (joint_sum / joints.len() as f64),
        TerminationError::Supplement => body_sum + joint_sum,
    }
}

/// c of each term w exp(−c Δ²), in the order of `TRACKING_REWARD_TERMS`; the last term is linear.
pub(crate) const EXPONENTS: [f64; MAX_REWARD_TERMS] = [40.0, 2.0, 10.0, 0.1, 0.0];

/// The reward's terms with their weights, in the order of `TRACKING_REWARD_TERMS`. The weights of the pose terms add up to
/// 0.45; joint velocities and termination have 0.5 each. The termination term is negative in a step that terminates.
pub(crate) fn terms(
    walker: &Walker,
    data: &Data,
    reference: &Reference,
    frame: usize,
    error: f64,
    threshold: f64,
) -> [f64; MAX_REWARD_TERMS] {
    let appendages = squared(&appendages(walker, data), reference.appendages(frame));
    let orientations: f64 = data.xquat()[walker.tracked.clone()]
        .iter()
        .zip(reference.body_quaternions(frame))
        .map(|(body, target)| half_angle_between(*body, *target).powi(2))
        .sum();
    let center_of_mass = squared(&data.subtree_com()[walker.frame], reference.center_of_mass(frame));
    let velocities = squared(&data.qvel()[ROOT_VELOCITIES..], reference.joints_velocity(frame));
    [
        0.5 * 0.15 * (-EXPONENTS[0] * appendages).exp(),
        0.5 * 0.65 * (-EXPONENTS[1] * orientations).exp(),
        0.5 * 0.1 * (-EXPONENTS[2] * center_of_mass).exp(),
        0.5 * (-EXPONENTS[3] * velocities).exp(),
        0.5 * (1.0 - error / threshold),
    ]
}

fn absolute(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum()
}

fn squared(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}
