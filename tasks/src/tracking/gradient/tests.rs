//! The derivative against finite differences.

use std::sync::Arc;

use comic_clips::Catalogue;
use comic_clips::spatial::norm;
use comic_experiment::{ClipSource, GradientOfReward, TRACKING_TERM_LIMITS, Tracking};

use super::*;
use crate::environment::{Environment as _, Simulated as _};
use crate::gradient::tests::moved;
use crate::tracking::environment::TrackingEnvironment;
use crate::tracking::reward;
use crate::tracking::task::TrackingTask;

const DECAY: f64 = 0.7;

fn task() -> Arc<TrackingTask> {
    task_with(DECAY)
}

fn task_with(decay: f64) -> Arc<TrackingTask> {
    let gradient = GradientOfReward { decay, ..GradientOfReward::default() };
    let config = Tracking { gradient, ..Tracking::default() };
    let catalogue = Catalogue::open(&[ClipSource::whole("builtin:CMU_007_01")]).unwrap();
    Arc::new(TrackingTask::new(&config, &catalogue).unwrap())
}

/// ε of the current state.
fn termination_error(task: &TrackingTask, data: &Data, frame: usize) -> f64 {
    let kind = task.config.termination_error;
    reward::termination_error(kind, &task.walker, data, &task.references[0], frame)
}

/// R of the current state.
fn softened(task: &TrackingTask, data: &Data, frame: usize) -> f64 {
    let (config, reference) = (&task.config, &task.references[0]);
    let error = termination_error(task, data, frame);
    let terms = reward::terms(&task.walker, data, reference, frame, error, config.termination_threshold);
    // The last term is the termination's.
    let softened = terms[..4].iter().zip(TRACKING_TERM_LIMITS).zip(config.gradient.powers());
    let rewards: f64 = softened
        .map(|((term, limit), power)| if power == 1.0 { *term } else { limit * (term / limit).powf(power) })
        .sum();
    let difference = |index: usize| data.qvel()[index] - reference.qvel(frame)[index];
    let size: f64 = (0..6).map(|index| (difference(index) / ROOT_VELOCITY_SCALES[index]).powi(2)).sum();
    rewards + barrier(1.0 - error / config.termination_threshold) + config.gradient.root_velocity * (-0.5 * size).exp()
}

/// In place of the termination term, for 1 − ε / τ.
fn barrier(left: f64) -> f64 {
    0.5 * if left > STEEPEST { left.ln() } else { STEEPEST.ln() + left / STEEPEST - 1.0 }
}

fn cosine(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>() / (squares(a) * squares(b)).sqrt()
}

/// After a few steps of the servo action from frame 20.
fn walking(task: &Arc<TrackingTask>) -> TrackingEnvironment {
    let mut environment = task.tracking_environment(1);
    environment.reset_to(0, 20).unwrap();
    let mut action = [0.0; 56];
    for _ in 0..4 {
        environment.servo_action(&mut action);
        environment.step(&action);
    }
    environment
}

#[test]
fn the_rewards_derivative_equals_finite_differences() {
    let task = task();
    let mut environment = walking(&task);
    let frame = environment.frame();
    let data = environment.simulation_mut();
    let (qpos, qvel) = (data.qpos().to_vec(), data.qvel().to_vec());
    // Near the reference, farther away, and where the episode is about to end.
    for lifted in [0.0, 0.9, 1.7] {
        let set = |data: &mut Data, index: usize, change: f64| {
            let (mut qpos, qvel) = moved(&qpos, &qvel, index, change);
            qpos[2] += lifted;
            data.qpos_mut().copy_from_slice(&qpos);
            data.qvel_mut().copy_from_slice(&qvel);
            data.forward();
        };
        set(data, 0, 0.0);
        let error = termination_error(&task, data, frame);
        let derivative = differentiate(&task.walker, data, &task.references[0], frame, error, &task.config);
        let mut at = |index: usize, change: f64| {
            set(data, index, change);
            softened(&task, data, frame)
        };
        for (index, found) in derivative.position.iter().chain(&derivative.velocity).enumerate() {
            let expected = (at(index, 1e-5) - at(index, -1e-5)) / 2e-5;
            let close = (found - expected).abs() < 1e-6 * norm(&[1.0, expected]);
            assert!(close, "{index} at ε = {error}: {found} is not {expected}");
        }
    }
}

/// The discounted softened rewards of these actions, from a state above the floor.
fn in_the_air(task: &Arc<TrackingTask>, actions: &[[f32; 56]]) -> (f64, Vec<[f32; 56]>) {
    let mut environment = walking(task);
    environment.record_gradients().unwrap();
    environment.simulation_mut().qpos_mut()[2] += 0.05;
    environment.simulation_mut().forward();
    let mut sum = 0.0;
    for (index, action) in actions.iter().enumerate() {
        environment.step(action);
        let frame = environment.frame();
        sum += DECAY.powi(index as i32) * softened(task, environment.simulation_mut(), frame);
    }
    (sum, environment.take_gradients())
}

#[test]
fn in_the_air_the_actions_derivative_has_the_direction_of_finite_differences() {
    let task = task();
    let environment = walking(&task);
    let mut action = [0.0; 56];
    environment.servo_action(&mut action);
    let actions = [action.map(|value| value * 0.9); 3];
    let (_, found) = in_the_air(&task, &actions);
    assert_eq!(found.len(), actions.len());
    let expected: Vec<f64> = (0..ACTIONS)
        .map(|servo| {
            let at = |change: f32| {
                let mut actions = actions;
                actions[0][servo] += change;
                in_the_air(&task, &actions).0
            };
            (at(1e-3) - at(-1e-3)) / 2e-3
        })
        .collect();
    let found = found[0].map(f64::from);
    let (cosine, ratio) = (cosine(&found, &expected), (squares(&found) / squares(&expected)).sqrt());
    assert!(cosine > 0.9 && (0.7..1.4).contains(&ratio), "cosine {cosine}, ratio {ratio}");
}

/// Cosine and ratio of sizes of the derivative of the sum of the softened rewards of `horizon` steps with respect to the first
/// action, against central differences of the true simulation. The state is that after four servo steps from this frame.
fn agreement(task: &Arc<TrackingTask>, frame: usize, horizon: usize) -> (f64, f64) {
    let mut environment = task.tracking_environment(1);
    let mut rewards = |change: Option<(usize, f64)>| {
        environment.record_gradients().unwrap();
        environment.reset_to(0, frame).unwrap();
        let mut action = [0.0; 56];
        for _ in 0..4 {
            environment.servo_action(&mut action);
            environment.step(&action);
        }
        environment.take_gradients();
        let mut sum = 0.0;
        for step in 0..horizon {
            environment.servo_action(&mut action);
            let mut control = action.map(f64::from);
            if let (0, Some((servo, change))) = (step, change) {
                control[servo] += change;
            }
            environment.step_control(&control);
            let frame = environment.frame();
            sum += softened(task, environment.simulation_mut(), frame);
        }
        (sum, environment.take_gradients())
    };
    let (_, found) = rewards(None);
    let found = found[0].map(f64::from);
    let expected: Vec<f64> =
        (0..ACTIONS).map(|servo| (rewards(Some((servo, 1e-4))).0 - rewards(Some((servo, -1e-4))).0) / 2e-4).collect();
    (cosine(&found, &expected), (squares(&found) / squares(&expected)).sqrt())
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// `docs/derivative.md` has the numbers. Narrow differences, since wide ones begin and end contacts.
#[test]
fn in_stance_the_actions_derivative_is_that_of_finite_differences() {
    let task = task_with(1.0);
    for (horizon, least) in [(1, 0.95), (3, 0.95), (5, 0.95), (10, 0.92)] {
        let found: Vec<(f64, f64)> = (0..9).map(|index| agreement(&task, 4 + 6 * index, horizon)).collect();
        let (cosine, size): (Vec<f64>, Vec<f64>) = found.into_iter().unzip();
        let (cosine, size) = (median(cosine), median(size));
        println!("{horizon}: cosine {cosine:.3}, size {size:.3}");
        assert!(cosine > least && (0.75..1.3).contains(&size), "{horizon} steps: cosine {cosine}, size {size}");
    }
}

#[test]
fn a_sequence_of_states_is_the_same_with_and_without_the_tape() {
    let task = task();
    let states = |records: bool| {
        let mut environment = task.tracking_environment(1);
        if records {
            environment.record_gradients().unwrap();
        }
        environment.reset_to(0, 10).unwrap();
        let mut action = [0.0; 56];
        let mut states = Vec::new();
        for _ in 0..40 {
            environment.servo_action(&mut action);
            environment.step(&action);
            let data = environment.simulation();
            states.push([data.qpos(), data.qvel(), data.act(), data.sensordata()].concat());
        }
        states
    };
    assert_eq!(states(true), states(false));
}

#[test]
fn a_body_that_has_no_derivative_is_refused() {
    let model = crate::humanoid::build(comic_clips::WalkerModel::Cmu2019).unwrap();
    let error = crate::gradient::GradientTape::new(&model, 0.9).unwrap_err().to_string();
    assert!(error.contains("vmpo.action_gradient") && error.contains("V2020"), "{error}");
}

#[test]
fn a_reward_after_the_episodes_end_does_not_count() {
    let task = task();
    let last = task.references[0].last_step(task.look_ahead);
    let gradients = |after: usize| {
        let mut environment = task.tracking_environment(1);
        environment.record_gradients().unwrap();
        environment.reset_to(0, last - 2).unwrap();
        let mut action = [0.0; 56];
        for _ in 0..2 {
            environment.servo_action(&mut action);
            environment.step(&action);
        }
        environment.reset_to(0, 20).unwrap();
        for _ in 0..after {
            environment.step(&action);
        }
        environment.take_gradients()
    };
    assert_eq!(gradients(0)[..2], gradients(3)[..2]);
    assert_eq!(gradients(3).len(), 5);
}

#[test]
fn an_action_beyond_its_bounds_is_not_pushed_further_out() {
    let task = task();
    let mut environment = walking(&task);
    environment.record_gradients().unwrap();
    let action: [f32; 56] = std::array::from_fn(|index| if index % 2 == 0 { 1.0 } else { -1.0 });
    environment.step(&action);
    let gradients = environment.take_gradients();
    assert!(gradients[0].iter().zip(action).all(|(derivative, action)| derivative * action <= 0.0), "{gradients:?}");
    assert!(gradients[0].iter().any(|derivative| *derivative != 0.0), "some point back");
}

#[test]
fn every_step_has_a_row_also_one_that_diverged() {
    let task = task();
    let mut environment = walking(&task);
    environment.record_gradients().unwrap();
    environment.step(&[0.0; 56]);
    environment.step(&[f32::NAN; 56]);
    environment.step(&[0.0; 56]);
    let gradients = environment.take_gradients();
    assert_eq!(gradients.len(), 3);
    assert!(gradients[0] != [0.0; 56] && gradients[1..] == [[0.0; 56]; 2]);
}
