//! What tasks of locomotion differentiate: the root's speed in a direction, and the head's height.

use comic_experiment::GradientOfSpeed;

use crate::gradient::{Forces, RewardDerivative};
use crate::rules::stage::Stage;

/// Share of the target speed around it where the reward is rounded (D). A corner would push in full strength in turns.
const ROUNDED: f64 = 0.2;

/// The head of a walking body is higher than this, and the scale of the term below this height, m (D).
const UPRIGHT: f64 = 1.5;
const UPRIGHT_SCALE: f64 = 0.3;

/// A direction that a task leads to.
pub(super) struct Way {
    /// x and y, a unit vector.
    pub(super) direction: [f64; 2],
    /// How far away the place is to which it leads, m: the direction turns as the root passes it. Infinite in a corridor.
    pub(super) distance: f64,
}

/// The derivative of R(v) + U(h), for the root's speed v along the way and the height h of the head; without a way of U(h) alone.
///
/// - R(v) = 1 − k((v − t) / t), where t is the experiment's speed or else `task_speed`, m/s; k(x) = x² / 2 `ROUNDED` up to
///   `ROUNDED` and |x| − `ROUNDED` / 2 beyond.
/// - U(h) is 0 from 1.5 m on, and falls by the weight `upright` in 0.3 m below.
pub(super) fn differentiate(
    stage: &Stage,
    way: Option<&Way>,
    task_speed: f64,
    config: &GradientOfSpeed,
) -> RewardDerivative {
    let target = if config.speed > 0.0 { config.speed } else { task_speed };
    let (mut derivative, data) = (RewardDerivative::ZERO, &stage.data);
    if let Some(Way { direction, distance }) = way {
        let velocity = [data.qvel()[0], data.qvel()[1]];
        let speed = velocity[0] * direction[0] + velocity[1] * direction[1];
        let slope = -((speed - target) / target / ROUNDED).clamp(-1.0, 1.0) / target;
        for axis in 0..2 {
            derivative.velocity[axis] = slope * direction[axis];
            derivative.position[axis] = -slope * (velocity[axis] - speed * direction[axis]) / distance;
        }
    }
    if stage.head_height() < UPRIGHT {
        let [.., head] = stage.arena.walker.appendages;
        let mut forces = Forces::new(data, stage.arena.walker.frame);
        forces.push(head, data.xpos()[head], [0.0, 0.0, config.upright / UPRIGHT_SCALE]);
        forces.add_to(data, &mut derivative);
    }
    derivative
}

/// R(v) + U(h); see [`differentiate`].
#[cfg(test)]
pub(super) fn reward(speed: f64, target: f64, height: f64) -> f64 {
    let upright = (height - UPRIGHT).min(0.0) / UPRIGHT_SCALE;
    let error = ((speed - target) / target).abs();
    upright + 1.0 - if error < ROUNDED { error * error / (2.0 * ROUNDED) } else { error - ROUNDED / 2.0 }
}

#[cfg(test)]
mod tests;
