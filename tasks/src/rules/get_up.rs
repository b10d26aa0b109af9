//! Get up and stand (CoMic supplement 1.3): an episode begins with a lying humanoid, or with one that falls.
//!
//! | constant | value | source |
//! | --- | --- | --- |
//! | share of lying starts | 0.05 | supplement, "about 5%" |
//! | reward | exp(−(h − h_target)²), h the head's height in m | supplement |
//! | length | 8 s, 267 steps, no early end | supplement ("a maximum reward of about 267") |
//! | target height | 1.808 m | the upright pose's, ours; the reward is 1 there |
//! | lying pose | any orientation, joints N(0, 0.3 rad), simulated for 3 s without control | ours |
//! | standing pose | 2 to 15 cm up, tilt N(0, 0.15 rad), joints N(0, 0.1 rad), velocities N(0, 0.3 m/s), N(0, 0.5 rad/s) | ours |
//! | task observation | the root's height, m | ours |
//!
//! All of them are fields of [`GetUp`].

use std::f64::consts::PI;
use std::sync::Arc;

use comic_clips::spatial::normalize;
use comic_clips::{Catalogue, JOINT_RANGES};
use comic_experiment::{CONTROL_TIMESTEP, GetUp, GradientOfStanding, LyingPose};
use rand::Rng as _;
use rand_distr::{Distribution as _, StandardNormal};
use rand_pcg::Pcg64;

use super::environment::RuledTask;
use super::interface::{Rules, Verdict};
use super::poses::{Pose, Poses, UP};
use super::stage::{Arena, Part, Stage};
use crate::achievement::Achievement;
use crate::arenas::floor;
use crate::build_task::{BuildTask, Context};
use crate::environment::Task;
use crate::error::Error;
use crate::gradient::{ACTIONS, Forces, RewardDerivative};
use crate::humanoid;
use crate::humanoid::observation::{Number, fill};
use crate::humanoid::walker::{ROOT_COORDINATES, ROOT_VELOCITIES};
use crate::physics::is_healthy;

/// Standard deviation of the joints of a pose that is dropped, rad.
const DROPPED_JOINTS: f64 = 0.3;
/// Control steps in which a dropped body falls and comes to rest: three seconds.
const SETTLING_STEPS: usize = (3.0 / CONTROL_TIMESTEP) as usize;
/// Poses are dropped from the smallest multiple of this height at which nothing touches the ground, m.
const DROP_STEP: f64 = 0.1;

/// The rules of get-up-and-stand.
#[derive(Debug)]
pub(crate) struct GetUpRules {
    config: GetUp,
    standing: Poses,
    /// `None` when lying poses are simulated.
    lying: Option<Poses>,
    arena: Arc<Arena>,
}

/// Get-up keeps nothing from step to step.
#[derive(Debug, Default)]
pub(crate) struct State;

impl BuildTask for GetUp {
    fn build(&self, context: &Context<'_>) -> Result<Arc<dyn Task>, Error> {
        Ok(Arc::new(RuledTask::new(GetUpRules::new(self, context.catalogue)?, context.spec()?)))
    }
}

impl GetUpRules {
    pub(crate) fn new(config: &GetUp, catalogue: &Catalogue) -> Result<Self, Error> {
        let lying = match config.lying_pose {
            LyingPose::Simulated => None,
            LyingPose::Clips => Some(Poses::of_clips(catalogue, 1)?),
        };
        let arena = Arc::new(Arena::new(humanoid::build_in(floor::floor()?)?)?);
        Ok(Self { config: config.clone(), standing: Poses::new(config.start_pose, catalogue)?, lying, arena })
    }

    /// A standing pose a little above the ground, which will fall.
    fn standing(&self, random: &mut Pcg64) -> Pose {
        let GetUp { drop_height: [low, high], tilt, joint_noise, velocity_noise, angular_velocity_noise, .. } =
            self.config;
        let mut pose = self.standing.draw(random);
        pose.position_mut()[2] += random.random_range(low..=high);
        let about: f64 = random.random_range(-PI..PI);
        let pose = pose.turned(UP, random.random_range(-PI..PI));
        let mut pose = pose.turned([about.cos(), about.sin(), 0.0], tilt * normal(random));
        disturb_joints(&mut pose, joint_noise, random);
        pose.qvel[..3].iter_mut().for_each(|velocity| *velocity += velocity_noise * normal(random));
        pose.qvel[3..].iter_mut().for_each(|velocity| *velocity += angular_velocity_noise * normal(random));
        pose
    }

    /// A lying pose at rest on the ground.
    fn lying(&self, stage: &mut Stage, random: &mut Pcg64) -> Pose {
        if let Some(poses) = &self.lying {
            return poses.draw(random).turned(UP, random.random_range(-PI..PI));
        }
        loop {
            let dropped = dropped(stage, random);
            stage.place(&dropped.qpos, &dropped.qvel);
            for _ in 0..SETTLING_STEPS {
                stage.step(&[0.0; 56]);
            }
            if is_healthy(&stage.data) {
                let mut pose = Pose::upright();
                pose.qpos.copy_from_slice(stage.data.qpos());
                return pose.moved(-pose.qpos[0], -pose.qpos[1]);
            }
        }
    }
}

/// A random pose with a random orientation, just above the ground.
fn dropped(stage: &mut Stage, random: &mut Pcg64) -> Pose {
    let mut pose = Pose::upright();
    // A normalised vector of normal numbers has a uniform direction.
    let orientation = normalize(std::array::from_fn(|_| normal(random)));
    pose.qpos[3..7].copy_from_slice(&orientation);
    disturb_joints(&mut pose, DROPPED_JOINTS, random);
    pose.position_mut()[2] = 0.0;
    loop {
        pose.position_mut()[2] += DROP_STEP;
        stage.place(&pose.qpos, &pose.qvel);
        // Parts of the body may touch each other.
        if !stage.contacts().any(|(one, other, _)| one == Part::Ground || other == Part::Ground) {
            return pose;
        }
    }
}

/// Adds noise of this standard deviation to the joints, within their ranges.
fn disturb_joints(pose: &mut Pose, deviation: f64, random: &mut Pcg64) {
    for (joint, [low, high]) in pose.joints_mut().iter_mut().zip(JOINT_RANGES) {
        *joint = (*joint + deviation * normal(random)).clamp(low, high);
    }
}

fn normal(random: &mut Pcg64) -> f64 {
    StandardNormal.sample(random)
}

/// exp(−(h − h_target)²), heights in m.
pub(crate) fn standing_reward(height: f64, target: f64) -> f64 {
    (-(height - target).powi(2)).exp()
}

impl Rules for GetUpRules {
    type State = State;

    fn stage(&self, _: &mut Pcg64) -> Result<Stage, Error> {
        Ok(Stage::new(Arc::clone(&self.arena)))
    }

    fn begin(&self, stage: &mut Stage, _: &mut State, random: &mut Pcg64) {
        let lies = random.random_bool(self.config.lying_share);
        let pose = if lies { self.lying(stage, random) } else { self.standing(random) };
        stage.place(&pose.qpos, &pose.qvel);
    }

    fn judge(&self, stage: &mut Stage, _: &mut State, _: &mut Pcg64) -> Verdict {
        Verdict::of(standing_reward(stage.head_height(), self.config.target_height), false)
    }

    /// Success: standing after the last step, the head at least at [`GetUp::STANDING_SHARE`] of its target height.
    fn achievement(&self, stage: &Stage, _: &State, failed: bool) -> Achievement {
        let lowest = GetUp::STANDING_SHARE * self.config.target_height;
        Achievement::new(!failed && stage.head_height() >= lowest)
    }

    fn observe<T: Number>(&self, stage: &Stage, _: &State, out: &mut [T]) {
        fill(out, [stage.root().0[2]]);
    }

    fn time_limit(&self) -> f64 {
        self.config.time_limit
    }

    fn training_time_limit(&self) -> f64 {
        let limit = self.config.training_time_limit;
        if limit > 0.0 { limit } else { self.config.time_limit }
    }

    fn gradient_decay(&self) -> Option<f64> {
        Some(self.config.gradient.decay)
    }

    /// Of the reward and of the terms of [`GradientOfStanding`].
    fn differentiate(&self, stage: &Stage, _: &State) -> RewardDerivative {
        let mut derivative = RewardDerivative::ZERO;
        let RewardDerivative { position, velocity } = &mut derivative;
        let GradientOfStanding { balance, stillness, pose, .. } = self.config.gradient;
        // ∂R/∂h is −2 (h − h_target) R.
        let (height, target) = (stage.head_height(), self.config.target_height);
        let slope = -2.0 * (height - target) * standing_reward(height, target);
        let [_, _, right, left, head] = stage.arena.walker.appendages;
        let (data, frame) = (&stage.data, stage.arena.walker.frame);
        let mut forces = Forces::new(data, frame);
        forces.push(head, data.xpos()[head], [0.0, 0.0, slope]);
        let distance = imbalance(stage);
        let term = balance * bell(&distance.map(|entry| entry / BALANCE_SCALE));
        let [x, y] = distance.map(|entry| -term * entry / (BALANCE_SCALE * BALANCE_SCALE));
        for foot in [right, left] {
            forces.push(foot, data.xipos()[foot], [-0.5 * x, -0.5 * y, 0.0]);
        }
        forces.push_center_of_mass(data, frame, [x, y, 0.0]);
        (velocity[0], velocity[1]) = (FALL_TIME * x, FALL_TIME * y);
        let scaled = scaled_root_velocity(stage);
        let term = stillness * bell(&scaled);
        for ((place, scaled), scale) in velocity.iter_mut().zip(scaled).zip(ROOT_VELOCITY_SCALES) {
            *place -= term * scaled / scale;
        }
        let joints = scaled_joints(stage);
        let term = pose * bell(&joints);
        for (place, joint) in position[ROOT_VELOCITIES..].iter_mut().zip(joints) {
            *place -= term * joint / JOINT_SCALE;
        }
        forces.add_to(data, &mut derivative);
        derivative
    }
}

/// exp(−½ Σ x²).
fn bell(values: &[f64]) -> f64 {
    (-0.5 * values.iter().map(|value| value * value).sum::<f64>()).exp()
}

/// From the middle of the feet to the extrapolated centre of mass, x and y, m.
fn imbalance(stage: &Stage) -> [f64; 2] {
    let [_, _, right, left, _] = stage.arena.walker.appendages;
    let (mass, feet) =
        (stage.data.subtree_com()[stage.arena.walker.frame], [right, left].map(|foot| stage.data.xipos()[foot]));
    let velocity = stage.data.qvel();
    std::array::from_fn(|axis| mass[axis] + FALL_TIME * velocity[axis] - 0.5 * (feet[0][axis] + feet[1][axis]))
}

fn scaled_root_velocity(stage: &Stage) -> [f64; ROOT_VELOCITIES] {
    std::array::from_fn(|index| stage.data.qvel()[index] / ROOT_VELOCITY_SCALES[index])
}

fn scaled_joints(stage: &Stage) -> [f64; ACTIONS] {
    std::array::from_fn(|joint| stage.data.qpos()[ROOT_COORDINATES + joint] / JOINT_SCALE)
}

/// Scale of the term of balance (D), m: a little less than a foot's length.
const BALANCE_SCALE: f64 = 0.2;
/// √(l / g) for a centre of mass l = 1 m above the ground, s.
const FALL_TIME: f64 = 0.32;
/// Scales of the term of stillness (D), m/s and rad/s.
const ROOT_VELOCITY_SCALES: [f64; ROOT_VELOCITIES] = [0.5, 0.5, 0.5, 2.0, 2.0, 2.0];
/// Scale of one of 56 joint angles in the term of the pose (D), rad: √56 × 0.3 rad.
const JOINT_SCALE: f64 = 2.245;

#[cfg(test)]
mod tests;
