//! The derivative of the speed against finite differences, in both tasks that have it.

use comic_experiment::{Corridor, Gaps, GoToTarget, StartPose};
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

use super::*;
use crate::gradient::tests::moved;
use crate::rules::corridor::CorridorRules;
use crate::rules::go_to_target::GoToTargetRules;
use crate::rules::interface::Rules;
use crate::rules::poses::Poses;

/// Compares the derivative at this root velocity, m/s, with central differences of `reward`.
fn check<R: Rules>(
    rules: &R,
    velocity: [f64; 2],
    lowered: f64,
    target: [f64; 2],
    reward: impl Fn(&Stage, &R::State) -> f64,
) where
    R::State: Target,
{
    let (mut random, mut state) = (Pcg64::seed_from_u64(1), R::State::default());
    let mut stage = rules.stage(&mut random).unwrap();
    rules.begin(&mut stage, &mut state, &mut random);
    state.aim(target);
    let (mut qpos, mut qvel) = (stage.data.qpos().to_vec(), stage.data.qvel().to_vec());
    qvel[..2].copy_from_slice(&velocity);
    // Upright, and about to fall.
    qpos[2] -= lowered;
    stage.place(&qpos, &qvel);
    let found = rules.differentiate(&stage, &state);
    for (index, found) in found.position.iter().chain(&found.velocity).enumerate() {
        let mut at = |change: f64| {
            let (qpos, qvel) = moved(&qpos, &qvel, index, change);
            stage.place(&qpos, &qvel);
            reward(&stage, &state)
        };
        let expected = (at(1e-5) - at(-1e-5)) / 2e-5;
        assert!((found - expected).abs() < 1e-6, "{velocity:?}, {index}: {found} is not {expected}");
    }
}

trait Target {
    fn aim(&mut self, target: [f64; 2]);
}

impl Target for crate::rules::corridor::State {
    fn aim(&mut self, _: [f64; 2]) {}
}

impl Target for crate::rules::go_to_target::State {
    fn aim(&mut self, target: [f64; 2]) {
        self.target = target;
    }
}

/// Backwards, standing, near the target speed, and too fast.
const VELOCITIES: [[f64; 2]; 4] = [[-0.5, 0.3], [0.0, 0.1], [1.4, -0.4], [4.0, 1.0]];

/// So much below the upright pose, whose head is at 1.8 m.
const LOWERED: [f64; 4] = [0.0, 0.7, 0.7, 0.0];

#[test]
fn along_the_corridor_it_equals_finite_differences() {
    let config = Corridor { start_pose: StartPose::Upright, target_velocity: 1.5, ..Corridor::default() };
    let rules = CorridorRules::new(&config, Poses::upright(), Gaps::default());
    for (velocity, lowered) in VELOCITIES.into_iter().zip(LOWERED) {
        check(&rules, velocity, lowered, [0.0; 2], |stage, _| reward(stage.data.qvel()[0], 1.5, stage.head_height()));
    }
}

#[test]
fn towards_the_target_it_equals_finite_differences_and_within_the_tolerance_the_head_alone_counts() {
    let config = GoToTarget { start_pose: StartPose::Upright, ..GoToTarget::default() };
    let rules = GoToTargetRules::new(&config, Poses::upright()).unwrap();
    let towards = |stage: &Stage, state: &crate::rules::go_to_target::State| {
        let (root, _) = stage.root();
        let way = [0, 1].map(|axis| state.target[axis] - root[axis]);
        let velocity = stage.data.qvel();
        reward((way[0] * velocity[0] + way[1] * velocity[1]) / way[0].hypot(way[1]), 1.0, stage.head_height())
    };
    for (velocity, lowered) in VELOCITIES.into_iter().zip(LOWERED) {
        check(&rules, velocity, lowered, [7.0, -6.0], towards);
    }
    let (mut random, mut state) = (Pcg64::seed_from_u64(1), crate::rules::go_to_target::State::default());
    let mut stage = rules.stage(&mut random).unwrap();
    rules.begin(&mut stage, &mut state, &mut random);
    let (root, _) = stage.root();
    state.target = [root[0] + 0.5, root[1]];
    let counts = |stage: &Stage| {
        let found = rules.differentiate(stage, &state);
        (found.velocity != [0.0; crate::gradient::VELOCITIES], found.position != [0.0; crate::gradient::VELOCITIES])
    };
    assert_eq!(counts(&stage), (false, false));
    let (mut qpos, qvel) = (stage.data.qpos().to_vec(), stage.data.qvel().to_vec());
    qpos[2] -= 0.7;
    stage.place(&qpos, &qvel);
    assert_eq!(counts(&stage), (false, true), "about to fall");
}
