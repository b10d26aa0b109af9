//! Starts, the reward, and its derivative.

use comic_experiment::{ClipSource, StartPose};
use rand::SeedableRng as _;

use super::super::environment::RuledEnvironment;
use super::*;
use crate::environment::{Environment as _, Outcome, Simulated as _};
use crate::gradient::tests::moved;

fn rules(config: &GetUp) -> GetUpRules {
    GetUpRules::new(config, &Catalogue::open(&[ClipSource::whole("builtin:stand")]).unwrap()).unwrap()
}

/// Heights of the head (m) after each of `count` resets.
fn starts(config: &GetUp, count: u64) -> Vec<f64> {
    let (rules, mut random) = (rules(config), Pcg64::seed_from_u64(1));
    let mut stage = rules.stage(&mut random).unwrap();
    let mut start = |_| {
        rules.begin(&mut stage, &mut State, &mut random);
        stage.head_height()
    };
    (0..count).map(&mut start).collect()
}

#[test]
fn about_one_start_in_twenty_is_lying_and_the_others_are_standing() {
    let heights = starts(&GetUp::default(), 1000);
    let lying = heights.iter().filter(|height| **height < 0.6).count();
    // Binomial with mean 50 and standard deviation 6.9.
    assert!((22..=78).contains(&lying), "{lying} of 1000 lie");
    assert!(heights.iter().all(|height| *height < 0.6 || *height > 1.5), "no other starts");
}

/// The reward and the terms of standing, of the current state.
fn differentiated(stage: &Stage, config: &GetUp) -> f64 {
    let GradientOfStanding { balance, stillness, pose, .. } = config.gradient;
    standing_reward(stage.head_height(), config.target_height)
        + balance * bell(&imbalance(stage).map(|entry| entry / BALANCE_SCALE))
        + stillness * bell(&scaled_root_velocity(stage))
        + pose * bell(&scaled_joints(stage))
}

#[test]
fn the_rewards_derivative_equals_finite_differences() {
    let (config, mut random) = (GetUp { lying_share: 0.0, ..GetUp::default() }, Pcg64::seed_from_u64(5));
    let rules = rules(&config);
    let mut stage = rules.stage(&mut random).unwrap();
    rules.begin(&mut stage, &mut State, &mut random);
    // Below the target, where the reward has a slope.
    let (mut qpos, qvel) = (stage.data.qpos().to_vec(), stage.data.qvel().to_vec());
    qpos[2] -= 0.5;
    stage.place(&qpos, &qvel);
    let found = rules.differentiate(&stage, &State);
    let mut at = |index: usize, change: f64| {
        let (qpos, qvel) = moved(&qpos, &qvel, index, change);
        stage.place(&qpos, &qvel);
        differentiated(&stage, &config)
    };
    for (index, found) in found.position.iter().chain(&found.velocity).enumerate() {
        let expected = (at(index, 1e-5) - at(index, -1e-5)) / 2e-5;
        assert!((found - expected).abs() < 1e-6, "{index}: {found} is not {expected}");
    }
}

#[test]
fn on_its_feet_the_actions_derivative_is_that_of_finite_differences() {
    let gradient = GradientOfStanding { decay: 1.0, ..GradientOfStanding::default() };
    let config = GetUp { lying_share: 0.0, drop_height: [0.0, 0.0], gradient, ..still() };
    let mut environment = RuledEnvironment::at(rules(&config), &Pose::upright(), State).unwrap();
    let hold = comic_clips::pose_to_action(&[0.0; ACTIONS]);
    // The derivative after so many steps from the upright pose, and the sum of what is differentiated over the next five steps,
    // of which the first has this action.
    let mut rollout = |before: usize, first: &[f64; ACTIONS]| {
        environment.reset_to(0, 7).unwrap();
        for _ in 0..before {
            environment.step_control(&hold);
        }
        environment.record_gradients().unwrap();
        let mut sum = 0.0;
        for step in 0..5 {
            environment.step_control(if step == 0 { first } else { &hold });
            sum += differentiated(environment.stage(), &config);
        }
        assert!(environment.stage().contacts().next().is_some(), "it stands on nothing");
        (sum, environment.take_gradients())
    };
    let product = |one: &[f64], other: &[f64]| one.iter().zip(other).map(|(one, other)| one * other).sum::<f64>();
    let (mut cosines, mut sizes) = (Vec::new(), Vec::new());
    for before in [4, 6, 8, 10, 12] {
        let found = rollout(before, &hold).1[0].map(f64::from);
        let expected: [f64; ACTIONS] = std::array::from_fn(|servo| {
            let mut at = |change: f64| {
                let mut first = hold;
                first[servo] += change;
                rollout(before, &first).0
            };
            (at(1e-4) - at(-1e-4)) / 2e-4
        });
        let (own, other) = (product(&found, &found), product(&expected, &expected));
        cosines.push(product(&found, &expected) / (own * other).sqrt());
        sizes.push((own / other).sqrt());
    }
    println!("{cosines:.3?} {sizes:.2?}");
    cosines.sort_by(f64::total_cmp);
    sizes.sort_by(f64::total_cmp);
    assert!(cosines[2] > 0.9 && (0.75..1.3).contains(&sizes[2]), "{cosines:?} {sizes:?}");
}

#[test]
fn every_step_has_a_derivative_and_a_step_along_it_lifts_the_head() {
    let gradient = GradientOfStanding { decay: 1.0, balance: 0.0, stillness: 0.0, pose: 0.0 };
    let config = GetUp { lying_share: 1.0, gradient, ..GetUp::default() };
    let spec = comic_experiment::TaskSpec::default();
    let task: Arc<dyn Task> = Arc::new(RuledTask::new(rules(&config), spec));
    let mut environment = task.environment(3).unwrap();
    environment.record_gradients().unwrap();
    // The sum of the rewards of five steps with this action.
    let mut rewards = |action: &[f32; 56]| {
        environment.reset_to(0, 7).unwrap();
        let sum: f64 = (0..5).map(|_| environment.step(action).reward()).sum();
        (sum, environment.take_gradients())
    };
    let action = [0.0; 56];
    let (before, gradients) = rewards(&action);
    assert_eq!(gradients.len(), 5);
    let length = gradients[0].iter().map(|entry| entry * entry).sum::<f32>().sqrt();
    assert!(length > 0.0, "the first step has no derivative");
    let moved = std::array::from_fn(|index| action[index] + 0.3 * gradients[0][index] / length);
    let (after, _) = rewards(&moved);
    assert!(after > before, "{after} is not above {before}");
}

#[test]
fn only_episodes_of_training_have_its_time_limit() {
    let config = GetUp { time_limit: 0.3, training_time_limit: 0.12, ..GetUp::default() };
    let task: Arc<dyn Task> = Arc::new(RuledTask::new(rules(&config), comic_experiment::TaskSpec::default()));
    let mut environment = task.environment(3).unwrap();
    let mut steps = |evaluates: bool| {
        if evaluates {
            environment.reset_to(0, 7).unwrap();
        } else {
            environment.reset();
        }
        let begun = (1..).find(|_| environment.step(&[0.0; 56]).outcome == Outcome::Truncated);
        (begun.unwrap(), environment.episode().steps_left)
    };
    assert_eq!([steps(false), steps(true), steps(false)], [(4, 4), (10, 10), (4, 4)]);
}

#[test]
fn a_lying_start_is_at_rest_on_the_ground() {
    let (config, mut random) = (GetUp { lying_share: 1.0, ..GetUp::default() }, Pcg64::seed_from_u64(2));
    let rules = rules(&config);
    let mut stage = rules.stage(&mut random).unwrap();
    for _ in 0..20 {
        rules.begin(&mut stage, &mut State, &mut random);
        assert!(stage.has_fallen(), "some part of it touches the ground");
        assert!(stage.data.qvel().iter().all(|velocity| *velocity == 0.0));
        assert!(stage.head_height() < 0.6, "{}", stage.head_height());
        // It stays there: no overlap with the ground throws it up.
        for _ in 0..10 {
            stage.step(&[0.0; 56]);
        }
        assert!(stage.head_height() < 0.7, "{}", stage.head_height());
    }
}

#[test]
fn a_standing_start_is_above_the_ground_and_falls_without_control() {
    let config = GetUp { lying_share: 0.0, ..GetUp::default() };
    let (rules, mut random) = (rules(&config), Pcg64::seed_from_u64(3));
    let mut stage = rules.stage(&mut random).unwrap();
    for _ in 0..10 {
        rules.begin(&mut stage, &mut State, &mut random);
        assert!(stage.head_height() > 1.5);
        for _ in 0..100 {
            stage.step(&[0.0; 56]);
        }
        assert!(stage.head_height() < 1.0, "{}", stage.head_height());
    }
}

#[test]
fn first_frames_of_clips_can_be_the_lying_poses() {
    let config = GetUp { lying_share: 1.0, lying_pose: LyingPose::Clips, ..GetUp::default() };
    assert!(starts(&config, 5).iter().all(|height| *height > 1.5), "this clip is of standing");
}

#[test]
fn the_reward_is_1_for_standing_upright_and_follows_the_formula() {
    let config = GetUp { lying_share: 0.0, drop_height: [0.0, 0.0], ..still() };
    let (rules, mut random) = (rules(&config), Pcg64::seed_from_u64(4));
    let mut stage = rules.stage(&mut random).unwrap();
    rules.begin(&mut stage, &mut State, &mut random);
    let Verdict { reward_terms, failed } = rules.judge(&mut stage, &mut State, &mut random);
    assert!((reward_terms[0] - 1.0).abs() < 1e-5, "{reward_terms:?}");
    assert!(!failed, "falling does not end the episode");
    // By hand: exp(−(0.14 − 1.808)²) and exp(−0.808²).
    assert!((standing_reward(0.14, 1.808) - 0.061_9).abs() < 1e-4);
    assert!((standing_reward(1.0, 1.808) - 0.520_5).abs() < 1e-4);
}

fn still() -> GetUp {
    GetUp {
        tilt: 0.0,
        joint_noise: 0.0,
        velocity_noise: 0.0,
        angular_velocity_noise: 0.0,
        start_pose: StartPose::Upright,
        ..GetUp::default()
    }
}

#[test]
fn an_episode_that_ends_low_or_diverges_is_no_success() {
    let rules = rules(&GetUp::default());
    let mut stage = rules.stage(&mut Pcg64::seed_from_u64(1)).unwrap();
    // 0.9 of the target height is 0.18 m below it.
    for (below, success) in [(0.0, true), (0.17, true), (0.19, false), (1.0, false)] {
        let mut pose = Pose::upright();
        pose.position_mut()[2] -= below;
        stage.place(&pose.qpos, &pose.qvel);
        assert_eq!(rules.achievement(&stage, &State, false), Achievement::new(success), "{below} m below");
    }

    let mut environment = RuledEnvironment::at(rules, &Pose::upright(), State).unwrap();
    assert!(environment.achievement().success, "it stands");
    let outcome = environment.step_control(&[f64::NAN; 56]).outcome;
    assert_eq!((outcome, environment.achievement().success), (Outcome::Diverged, false));
}

#[test]
fn success_is_decided_at_the_end_and_a_body_that_has_fallen_by_then_has_none() {
    let config = GetUp { lying_share: 0.0, time_limit: 3.0, ..GetUp::default() };
    let mut environment = RuledEnvironment::at(rules(&config), &Pose::upright(), State).unwrap();
    environment.reset_to(0, 7).unwrap();
    assert!(environment.achievement().success, "it begins above the ground");
    while environment.step_control(&[0.0; 56]).outcome == Outcome::Running {}
    assert!(!environment.achievement().success);
}
