//! The derivative of tracking's reward with respect to the state. It has softer exponents, a barrier before the termination
//! threshold, and a term for the root's velocity ([`GradientOfReward`](comic_experiment::GradientOfReward)).

use comic_clips::spatial::{FlatMatrix, Vector, normalize, rotated, rotation_between, scale, subtract};
use comic_experiment::{TRACKING_TERM_LIMITS, Tracking};

use super::reference::Reference;
use super::reward::EXPONENTS;
use crate::gradient::{ACTIONS, Forces, RewardDerivative};
use crate::humanoid::features::appendages;
use crate::humanoid::walker::{ROOT_COORDINATES, ROOT_VELOCITIES, Walker};
use crate::physics::Data;

/// R has the term w exp(−½ Σ (Δ / scale)²) for the root's velocity (D): the scales, m/s and rad/s.
const ROOT_VELOCITY_SCALES: [f64; ROOT_VELOCITIES] = [0.3, 0.3, 0.3, 1.5, 1.5, 1.5];

/// The barrier ½ ln(1 − ε / τ) goes on as its tangent where 1 − ε / τ is below this (D). So it is finite when an episode ends.
const STEEPEST: f64 = 0.1;

/// The derivative of the current state, at frame `frame` of the reference, where the termination error is `error`.
pub(super) fn differentiate(
    walker: &Walker,
    data: &Data,
    reference: &Reference,
    frame: usize,
    error: f64,
    config: &Tracking,
) -> RewardDerivative {
    let mut derivative = RewardDerivative::ZERO;
    let RewardDerivative { position, velocity } = &mut derivative;
    let powers = config.gradient.powers();
    let differences = Differences::new(walker, data, reference, frame);
    // A term w exp(−c Δ²): its derivative with respect to Δ² is −c times the term.
    let slope = |term: usize, squares: f64| {
        let exponent = EXPONENTS[term] * powers[term];
        -exponent * TRACKING_TERM_LIMITS[term] * (-exponent * squares).exp()
    };
    let appendages = 2.0 * slope(0, squares(differences.appendages.as_flattened()));
    let half_angles: f64 = differences.rotations.iter().map(|rotation| squares(rotation) / 4.0).sum();
    let rotations = 0.5 * slope(1, half_angles);
    let center = 2.0 * slope(2, squares(&differences.center_of_mass));
    let velocities = 2.0 * slope(3, squares(&differences.joint_velocities));
    for (place, difference) in velocity[ROOT_VELOCITIES..].iter_mut().zip(&differences.joint_velocities) {
        *place = velocities * difference;
    }
    // The reward has no term for the root's velocity, but a body that loses its balance differs there first.
    let root = &differences.root_velocity;
    let scales = ROOT_VELOCITY_SCALES;
    let size: f64 = root.iter().zip(scales).map(|(difference, scale)| (difference / scale).powi(2)).sum();
    for ((place, difference), scale) in velocity.iter_mut().zip(root).zip(scales) {
        *place = -config.gradient.root_velocity * (-0.5 * size).exp() * difference / (scale * scale);
    }
    // The termination term, ½ (1 − ε / τ), has one slope everywhere. The barrier has the same slope at the reference, and a
    // steeper one before a fall. ε is linear in every distance.
    let threshold = config.termination_threshold;
    let barrier = -0.5 / threshold / (1.0 - error / threshold).max(STEEPEST);
    let coordinate = barrier * 0.5 / (3 * differences.positions.len()) as f64;
    let joint = barrier * 0.5 / differences.joints.len() as f64;
    for (place, difference) in position[ROOT_VELOCITIES..].iter_mut().zip(&differences.joints) {
        *place = joint * sign(*difference);
    }
    let mut forces = Forces::new(data, walker.frame);
    for (index, body) in walker.tracked.clone().enumerate() {
        let force = differences.positions[index].map(|difference| coordinate * sign(difference));
        forces.push(body, data.xpos()[body], force);
        forces.turn(body, scale(rotations, differences.rotations[index]));
    }
    // An appendage is seen from the root, so a force on it has its opposite on the root, at the same point.
    let rotation = data.xmat()[walker.root];
    for (difference, body) in differences.appendages.iter().zip(walker.appendages) {
        let (force, point) = (into_world(&rotation, scale(appendages, *difference)), data.xpos()[body]);
        forces.push(body, point, force);
        forces.push(walker.root, point, scale(-1.0, force));
    }
    forces.push_center_of_mass(data, walker.frame, scale(center, differences.center_of_mass));
    forces.add_to(data, &mut derivative);
    derivative
}

/// What the reward compares: the body less the reference.
struct Differences {
    /// m, world.
    positions: Vec<Vector>,
    /// rad.
    joints: [f64; ACTIONS],
    /// Rotations from the reference's bodies to the bodies, axis times angle, rad, world.
    rotations: Vec<Vector>,
    /// m, in the root's frame.
    appendages: [Vector; 5],
    /// m, world.
    center_of_mass: Vector,
    /// rad/s.
    joint_velocities: [f64; ACTIONS],
    /// m/s in the world, and rad/s in the root's frame.
    root_velocity: [f64; ROOT_VELOCITIES],
}

impl Differences {
    fn new(walker: &Walker, data: &Data, reference: &Reference, frame: usize) -> Self {
        let targets = reference.body_positions(frame).as_chunks::<3>().0;
        let bodies = data.xpos()[walker.tracked.clone()].iter().zip(targets);
        let orientations = data.xquat()[walker.tracked.clone()].iter().zip(reference.body_quaternions(frame));
        let (joints, velocities) = (&data.qpos()[ROOT_COORDINATES..], &data.qvel()[ROOT_VELOCITIES..]);
        let (own, target) = (appendages(walker, data), reference.appendages(frame));
        Self {
            positions: bodies.map(|(body, target)| subtract(*body, *target)).collect(),
            joints: std::array::from_fn(|joint| joints[joint] - reference.joints(frame)[joint]),
            rotations: orientations
                .map(|(body, target)| {
                    let (body, target) = (normalize(*body), normalize(*target));
                    rotated(target, rotation_between(target, body))
                })
                .collect(),
            appendages: std::array::from_fn(|index| {
                std::array::from_fn(|axis| own[3 * index + axis] - target[3 * index + axis])
            }),
            center_of_mass: subtract(data.subtree_com()[walker.frame], *reference.center_of_mass(frame)),
            root_velocity: std::array::from_fn(|index| data.qvel()[index] - reference.qvel(frame)[index]),
            joint_velocities: std::array::from_fn(|joint| velocities[joint] - reference.joints_velocity(frame)[joint]),
        }
    }
}

/// R v: from the frame to the world.
fn into_world(rotation: &FlatMatrix, v: Vector) -> Vector {
    std::array::from_fn(|row| (0..3).map(|column| rotation[3 * row + column] * v[column]).sum())
}

fn squares(values: &[f64]) -> f64 {
    values.iter().map(|value| value * value).sum()
}

/// −1, 0 or 1.
fn sign(value: f64) -> f64 {
    if value == 0.0 { 0.0 } else { value.signum() }
}

#[cfg(test)]
mod tests;
