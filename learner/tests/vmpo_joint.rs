//! Joint training: one low level, an encoder, a value function and a temperature for each task.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

mod vmpo_support;

use comic_experiment::Experiment;
use comic_learner::algorithm::Algorithm as _;
use comic_learner::algorithm::minibatch::MinibatchTensors;
use comic_learner::vmpo::VmpoLearner;
use comic_networks::{NormaliserStatistics, Policy as _, RecurrentState, Routing};
use tch::{Device, Tensor};
use vmpo_support::{LENGTH, Numbers, Unrolls, difference, every_low_level, joint_spec, learner_of, state};

const COUNT: usize = 5;
/// The tasks of the unrolls: tracking's clips are 0 to 2, getting up's is 3.
const TASKS: [usize; COUNT] = [0, 1, 0, 1, 0];
/// Width of a task observation, and of getting up's own.
const WIDTHS: (usize, usize) = (4, 2);

fn learner(experiment: &Experiment) -> VmpoLearner {
    learner_of(&joint_spec(), experiment, 1)
}

/// Unrolls of both tasks that this learner's own policy makes, acting step by step: one with two episodes, and one whose
/// second half is padding.
fn unrolls(learner: &VmpoLearner, experiment: &Experiment, seed: u64) -> Unrolls {
    let mut unrolls = Unrolls::random(seed, COUNT).end_episode(0, 3, true);
    let mut numbers = Numbers::new(seed + 100);
    unrolls.task_count = 2;
    unrolls.tasks = TASKS.to_vec();
    unrolls.reward = numbers.take(COUNT * LENGTH);
    for (row, clip) in unrolls.clip.iter_mut().enumerate() {
        *clip = if TASKS[row / (LENGTH + 1)] == 1 { 3 } else { *clip };
    }
    for (row, observation) in unrolls.task.chunks_exact_mut(WIDTHS.0).enumerate() {
        if TASKS[row / (LENGTH + 1)] == 1 {
            observation[..WIDTHS.0 - WIDTHS.1].fill(0.0);
        }
    }
    // Unroll 1 ends its episode in row 4, and the next episode belongs to another task.
    for t in 4..LENGTH {
        unrolls.valid[LENGTH + t] = 0.0;
        unrolls.discount[LENGTH + t] = 0.0;
        unrolls.first[LENGTH + 1 + t + 1] = 1.0;
    }
    let (latent, state) = (experiment.network.latent.size, experiment.network.state_size());
    unrolls.state = numbers.take(COUNT * state);
    let matrix = |values: &[f32], width: usize| Tensor::from_slice(values).reshape([COUNT as i64, width as i64]);
    let mut recurrent_state = matrix(&unrolls.state, state);
    let mut previous = matrix(&numbers.take(COUNT * latent), latent);
    let at = |values: &[f32], length: usize, t: usize| {
        let width = values.len() / (COUNT * length);
        Tensor::from_slice(values).reshape([COUNT, length, width].map(|size| size as i64)).select(1, t as i64)
    };
    let (mut means, mut stds, mut weights, mut latents) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for t in 0..LENGTH {
        let within = 1.0 - at(&unrolls.first, LENGTH + 1, t);
        (previous, recurrent_state) = (previous * &within, recurrent_state * within);
        latents.push(previous.copy());
        let acting = comic_networks::acting(|| {
            let (proprioception, task) = (at(&unrolls.proprioception, LENGTH + 1, t), at(&unrolls.task, LENGTH + 1, t));
            let routing = Routing::grouped(&TASKS, 2);
            let observation = learner.policy().normalise(&proprioception, &task, None, &routing);
            let recurrent = RecurrentState { state: &recurrent_state, first: None };
            learner.policy().act(&observation, &previous, &at(&unrolls.latent_noise, LENGTH, t), recurrent)
        });
        let (mean, std, log_weights) = acting.action.to_rows();
        (previous, recurrent_state) = (acting.latent, acting.state);
        means.push(mean);
        stds.push(std);
        weights.extend(log_weights);
    }
    let unrolled = |steps: &[Tensor]| match steps {
        [] => Vec::new(),
        steps => Vec::<f32>::try_from(Tensor::stack(steps, 1).flatten(0, -1).contiguous()).unwrap(),
    };
    (unrolls.mean, unrolls.std) = (unrolled(&means), unrolled(&stds));
    (unrolls.log_weights, unrolls.previous_latent) = (unrolled(&weights), unrolled(&latents));
    unrolls
}

/// Steps two learners, one on each minibatch, and returns the difference of their states.
fn compare(experiment: &Experiment, left: &MinibatchTensors, right: &MinibatchTensors) -> f64 {
    let (mut one, mut other) = (learner(experiment), learner(experiment));
    one.step(left).unwrap();
    other.step(right).unwrap();
    difference(&one, &other)
}

/// The names of what a step changed.
fn changed(experiment: &Experiment, unrolls: &Unrolls) -> Vec<String> {
    let mut learner = learner(experiment);
    let before = state(&learner);
    learner.step(&unrolls.minibatch()).unwrap();
    let moved =
        |((name, before), (_, after)): ((String, Vec<f64>), (String, Vec<f64>))| (before != after).then_some(name);
    before.into_iter().zip(state(&learner)).filter_map(moved).collect()
}

#[test]
fn acting_step_by_step_is_acting_on_the_whole_unroll() {
    for experiment in every_low_level() {
        let learner = learner(&experiment);
        let unrolls = unrolls(&learner, &experiment, 2);
        // An actor has a row for each environment, the learner one for each unroll, in blocks.
        let acting = unrolls.act_at_once(&learner, &experiment, &Routing::blocked(&TASKS, 2, Device::Cpu));
        unrolls.assert_decided(experiment.network.low_level.name(), &acting);
    }
}

#[test]
fn acting_step_by_step_is_learning_on_the_whole_unroll() {
    for experiment in every_low_level() {
        let mut learner = learner(&experiment);
        let losses = learner.step(&unrolls(&learner, &experiment, 2).minibatch()).unwrap().to_values();
        for kl in ["kl_mean", "kl_std", "kl_weights"].map(|kl| losses.get(kl).unwrap()) {
            assert!(kl.abs() < 1e-5, "{}: {losses:?}", experiment.network.low_level);
        }
    }
}

#[test]
fn every_tasks_observations_are_normalised_by_its_own_statistics() {
    let mut experiment = vmpo_support::experiment();
    experiment.network.normaliser_steps = 1;
    let statistics = |second: f32| NormaliserStatistics {
        proprioception_mean: vec![0.1; 5],
        proprioception_std: vec![0.8; 5],
        task_mean: [[0.2; 4], [second; 4]].concat(),
        task_std: [[0.5; 4], [2.0; 4]].concat(),
    };
    let mut learner = learner(&experiment);
    learner.set_normaliser(&statistics(-0.3)).unwrap();
    let unrolls = unrolls(&learner, &experiment, 7);
    let losses = learner.step(&unrolls.minibatch()).unwrap().to_values();
    assert!(losses.get("kl_mean").unwrap().abs() < 1e-5, "acting and learning take the same ones: {losses:?}");
    let mut other = self::learner(&experiment);
    other.set_normaliser(&statistics(0.9)).unwrap();
    let of_tracking = |learner: &VmpoLearner| {
        let changed = self::unrolls(learner, &experiment, 7);
        let width = changed.mean.len() / COUNT;
        (changed.mean[..width].to_vec(), changed.mean[width..2 * width].to_vec())
    };
    let mut same = self::learner(&experiment);
    same.set_normaliser(&statistics(-0.3)).unwrap();
    let ((first, second), (first_moved, second_moved)) = (of_tracking(&same), of_tracking(&other));
    assert_eq!(first, first_moved, "getting up's statistics are nothing to tracking");
    assert_ne!(second, second_moved);
}

#[test]
fn another_tasks_encoder_is_noticed() {
    let experiment = vmpo_support::experiment();
    let mut learner = learner(&experiment);
    let mut unrolls = unrolls(&learner, &experiment, 2);
    unrolls.tasks = TASKS.map(|task| 1 - task).to_vec();
    let losses = learner.step(&unrolls.minibatch()).unwrap().to_values();
    assert!(losses.get("kl_mean").unwrap() > 1e-5, "{losses:?}");
}

#[test]
fn permuting_the_batch_changes_nothing() {
    for experiment in every_low_level() {
        let base = unrolls(&learner(&experiment), &experiment, 3).minibatch();
        let permuted = base.select(&[3, 0, 4, 1, 2]);
        assert!(compare(&experiment, &base, &permuted) < 1e-5, "{}", experiment.network.low_level);
    }
}

#[test]
fn padding_changes_nothing() {
    for experiment in every_low_level() {
        let base = unrolls(&learner(&experiment), &experiment, 3);
        let mut other = base.clone();
        // Rows 5 and later of unroll 1; row 4 is its episode's last observation, from which it may be bootstrapped.
        for (values, length) in
            [(&mut other.proprioception, LENGTH + 1), (&mut other.task, LENGTH + 1), (&mut other.mean, LENGTH)]
        {
            let width = values.len() / (COUNT * length);
            values[(length + 5) * width..2 * length * width].fill(0.7);
        }
        assert_eq!(
            compare(&experiment, &base.minibatch(), &other.minibatch()),
            0.0,
            "{}",
            experiment.network.low_level
        );
    }
}

#[test]
fn a_task_teaches_its_own_encoder_value_and_temperature_and_the_shared_low_level() {
    let experiment = vmpo_support::experiment();
    let mut unrolls = unrolls(&learner(&experiment), &experiment, 4);
    // Only getting up is left.
    for (row, valid) in unrolls.valid.iter_mut().enumerate() {
        *valid = if TASKS[row / LENGTH] == 1 { *valid } else { 0.0 };
    }
    let changed = changed(&experiment, &unrolls);
    let any = |prefix: &str| changed.iter().any(|name| name.starts_with(prefix));
    assert!(any("policy.encoder.get-up.") && any("value.get-up.") && any("policy.low_level."), "{changed:?}");
    assert!(!any("policy.encoder.tracking.") && !any("value.tracking."), "{changed:?}");
    let mut learner = learner(&experiment);
    let losses = learner.step(&unrolls.minibatch()).unwrap().to_values();
    assert_eq!(losses.temperatures[0], 1.0, "an absent task's temperature stays");
    assert_ne!(losses.temperatures[1], 1.0);
}

#[test]
fn advantages_of_one_task_do_not_crowd_out_the_others() {
    let mut experiment = vmpo_support::experiment();
    let base = unrolls(&learner(&experiment), &experiment, 5);
    let mut rich = base.clone();
    for (row, reward) in rich.reward.iter_mut().enumerate() {
        *reward += if TASKS[row / LENGTH] == 1 { 1000.0 } else { 0.0 };
    }
    let tracking_encoder_moves_as_before = |experiment: &Experiment| {
        let after = |unrolls: &Unrolls| {
            let mut learner = learner(experiment);
            learner.step(&unrolls.minibatch()).unwrap();
            state(&learner)
        };
        let is_encoder = |name: &str| name.starts_with("policy.encoder.tracking.");
        let pairs = after(&base).into_iter().zip(after(&rich));
        pairs.filter(|((name, _), _)| is_encoder(name)).all(|((_, left), (_, right))| left == right)
    };
    assert!(tracking_encoder_moves_as_before(&experiment));
    experiment.vmpo.temperature_per_task = false;
    assert!(!tracking_encoder_moves_as_before(&experiment), "one E-step ranks all steps");
}

#[test]
fn without_a_temperature_for_each_task_there_is_one() {
    let mut experiment = vmpo_support::experiment();
    assert_eq!(learner(&experiment).multipliers().temperatures().size(), [2]);
    experiment.vmpo.temperature_per_task = false;
    assert_eq!(learner(&experiment).multipliers().temperatures().size(), [1]);
}

#[test]
fn a_batch_of_other_tasks_is_refused() {
    let experiment = vmpo_support::experiment();
    let mut learner = learner(&experiment);
    let mut unrolls = unrolls(&learner, &experiment, 6);
    unrolls.tasks[2] = 2;
    let error =
        MinibatchTensors::new(&unrolls.arrays(), &unrolls.tasks, &unrolls.shape(), tch::Device::Cpu).unwrap_err();
    assert_eq!(error.to_string(), "an unroll is of task 2, but there are only 2 tasks");
    unrolls.task_count = 3;
    let error = learner.step(&unrolls.minibatch()).unwrap_err().to_string();
    assert!(error.contains("tasks: 3"), "{error}");
}

#[test]
fn the_simulators_derivative_is_divided_by_the_temperature_of_its_own_task() {
    let mut experiment = vmpo_support::experiment();
    experiment.vmpo.action_gradient = 1.0;
    let mut base = unrolls(&learner(&experiment), &experiment, 8);
    base.action_gradient = vec![0.0; base.action.len()];
    let mut getting_up = base.clone();
    let width = base.action.len() / (COUNT * LENGTH);
    for (row, derivative) in getting_up.action_gradient.chunks_exact_mut(width).enumerate() {
        derivative.fill(if TASKS[row / LENGTH] == 1 { 1.0 } else { 0.0 });
    }
    // What the derivative of getting up adds to the loss.
    let added = |temperatures: [f32; 2]| {
        let total = |unrolls: &Unrolls| {
            let mut learner = learner(&experiment);
            let mut state = learner.state();
            let (_, multipliers) = state.iter_mut().find(|(name, _)| name == "multipliers").unwrap();
            for (task, temperature) in temperatures.into_iter().enumerate() {
                let _ = multipliers.get(task as i64).fill_(f64::from(temperature));
            }
            learner.load_state(&state).unwrap();
            learner.step(&unrolls.minibatch()).unwrap().to_values().get("total_loss").unwrap()
        };
        total(&getting_up) - total(&base)
    };
    let (even, other, own) = (added([1.0, 1.0]), added([2.0, 1.0]), added([1.0, 2.0]));
    assert!(even.abs() > 1e-3, "{even}");
    assert!((other - even).abs() < 1e-5 && (2.0 * own - even).abs() < 1e-5, "{even} {other} {own}");
}
