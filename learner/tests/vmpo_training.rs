//! The learner over several steps: its state, and that it learns.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

mod vmpo_support;

use comic_experiment::{Experiment, Prior};
use comic_learner::algorithm::Algorithm as _;
use comic_learner::algorithm::error::Error;
use comic_learner::algorithm::loss_report::Losses;
use comic_learner::algorithm::minibatch::MinibatchTensors;
use comic_learner::vmpo::VmpoLearner;
use tch::{Kind, Tensor};
use vmpo_support::{LENGTH, Numbers, UNROLLS, Unrolls, experiment, learner, state, values};

/// Adam as it is used: its own ε, and learning rates that suit small networks.
fn training() -> Experiment {
    let mut experiment = experiment();
    experiment.optimiser.epsilon = 1e-8;
    experiment.optimiser.learning_rate = 3e-3;
    experiment.optimiser.multiplier_learning_rate = 1e-2;
    experiment.network.latent.prior = Prior::Ar1 { alpha: 0.95 };
    experiment
}

fn unrolls(seed: u64) -> Unrolls {
    Unrolls::random(seed, UNROLLS).end_episode(2, 4, true)
}

#[test]
fn a_restored_learner_continues_bit_for_bit() {
    let mut original = learner(&training(), 1);
    for seed in 0..3 {
        original.step(&unrolls(seed).minibatch()).unwrap();
    }
    original.set_learning_rates(1e-3, 5e-3);
    let saved = original.state();
    let mut restored = learner(&training(), 2);
    assert_ne!(state(&restored), state(&original));
    restored.load_state(&saved).unwrap();
    for seed in 3..6 {
        let (left, right) = (original.step(&unrolls(seed).minibatch()), restored.step(&unrolls(seed).minibatch()));
        assert_eq!(left.unwrap().to_values(), right.unwrap().to_values());
    }
    assert_eq!(state(&restored), state(&original));
}

#[test]
fn a_saved_state_does_not_change_with_the_learner() {
    let mut learner = learner(&training(), 1);
    let saved = learner.state();
    let before: Vec<Vec<f32>> = saved.iter().map(|(_, tensor)| values(&tensor.to_kind(Kind::Float))).collect();
    learner.step(&unrolls(1).minibatch()).unwrap();
    let after: Vec<Vec<f32>> = saved.iter().map(|(_, tensor)| values(&tensor.to_kind(Kind::Float))).collect();
    assert_eq!(before, after);
}

#[test]
fn a_scheduled_deviation_falls_geometrically_with_the_budget() {
    let mut experiment = training();
    (experiment.network.initial_std, experiment.network.final_std) = (0.16, 0.04);
    let mut learner = learner(&experiment, 1);
    for (used, expected) in [(0.0, 0.16), (0.5, 0.08), (1.0, 0.04)] {
        learner.set_progress(used);
        let report = learner.step(&unrolls(1).minibatch()).unwrap().to_values();
        let found = report.get("policy_std").unwrap();
        assert!((found - expected).abs() < 1e-6, "{used}: {found} is not {expected}");
    }
}

fn refused(alter: impl FnOnce(&mut Vec<(String, Tensor)>)) -> String {
    let mut learner = learner(&training(), 1);
    let before = state(&learner);
    let mut other = self::learner(&training(), 2).state();
    alter(&mut other);
    let error: Error = learner.load_state(&other).unwrap_err();
    assert_eq!(state(&learner), before, "a refused state changed the learner");
    error.to_string()
}

#[test]
fn a_state_that_does_not_fit_changes_nothing_and_names_what_is_wrong() {
    let missing = refused(|state| state.retain(|(name, _)| name != "multipliers"));
    assert!(missing.contains("multipliers"), "{missing}");
    let unknown = refused(|state| state.push(("intruder".into(), Tensor::from(1f32))));
    assert!(unknown.contains("intruder"), "{unknown}");
    let reshaped = refused(|state| {
        let entry = state.iter_mut().find(|(name, _)| name == "multipliers").unwrap();
        entry.1 = Tensor::ones([4], (Kind::Float, tch::Device::Cpu));
    });
    assert!(reshaped.contains("multipliers") && reshaped.contains("[4]"), "{reshaped}");
    let converted = refused(|state| {
        let entry = state.iter_mut().find(|(name, _)| name == "multipliers").unwrap();
        entry.1 = entry.1.to_kind(Kind::Double);
    });
    assert!(converted.contains("Double"), "{converted}");
}

#[test]
fn a_state_holds_everything_that_is_trained() {
    let learner = learner(&training(), 1);
    let names: Vec<String> = learner.state().into_iter().map(|(name, _)| name).collect();
    for (name, tensor) in learner.policy_store().variables() {
        assert!(names.contains(&format!("policy.{name}")));
        assert_eq!(names.contains(&format!("adam.first.policy.{name}")), tensor.requires_grad(), "{name}");
    }
    assert!(names.iter().any(|name| name == "value.tracking.clip_embedding"));
}

/// Rewards whose squares overflow, and an observation that is NaN. The validation would refuse both.
fn poisoned(seed: u64) -> Unrolls {
    let mut unrolls = unrolls(seed);
    unrolls.reward.fill(1e30);
    unrolls.proprioception[0] = f32::NAN;
    unrolls
}

fn bits(learner: &VmpoLearner) -> Vec<(String, Vec<u64>)> {
    state(learner).into_iter().map(|(name, values)| (name, values.into_iter().map(f64::to_bits).collect())).collect()
}

#[test]
fn a_step_that_is_not_finite_changes_not_one_bit_and_is_reported() {
    for taken_before in 0..3 {
        let mut learner = learner(&training(), 1);
        (0..taken_before).for_each(|seed| drop(learner.step(&unrolls(seed).minibatch()).unwrap()));
        let before = bits(&learner);
        let report = learner.step(&poisoned(9).minibatch()).unwrap().to_values();
        assert_eq!((report.steps, report.skipped, report.skipped_last), (1, 1, 1), "{report:?}");
        assert_eq!(bits(&learner), before);
        assert!(learner.is_finite());
    }
}

#[test]
fn a_skipped_step_does_not_change_the_steps_after_it() {
    let (mut spared, mut struck) = (learner(&training(), 1), learner(&training(), 1));
    for seed in 0..4 {
        let _ = struck.step(&poisoned(seed).minibatch()).unwrap();
        let (left, right) = (spared.step(&unrolls(seed).minibatch()), struck.step(&unrolls(seed).minibatch()));
        assert_eq!(left.unwrap().to_values(), right.unwrap().to_values());
    }
    assert_eq!(bits(&spared), bits(&struck));
}

#[test]
fn a_mean_is_over_the_steps_that_were_taken_and_counts_the_others() {
    let mut learner = learner(&training(), 1);
    let (good, bad) = (unrolls(1).minibatch(), poisoned(1).minibatch());
    let mut steps = |of: &[&MinibatchTensors]| -> Vec<Losses> {
        of.iter().map(|minibatch| learner.step(minibatch).unwrap()).collect()
    };
    let mixed = steps(&[&bad, &good, &bad, &good, &bad, &bad]);
    let mean = Losses::mean(&mixed).unwrap().to_values();
    assert_eq!((mean.steps, mean.skipped, mean.skipped_last), (6, 4, 2));
    let taken = [1, 3].map(|step| mixed[step].to_values().get("total_loss").unwrap());
    assert_eq!(mean.get("total_loss").unwrap(), f32::midpoint(taken[0], taken[1]));
    assert!(mean.is_finite());
    let none = Losses::mean(&steps(&[&bad, &bad])).unwrap().to_values();
    assert_eq!((none.steps, none.skipped, none.skipped_last), (2, 2, 2));
    assert!(!none.is_finite());
}

#[test]
fn parameters_that_are_not_finite_are_noticed() {
    let mut experiment = training();
    experiment.optimiser.learning_rate = 1e38;
    let mut learner = learner(&experiment, 1);
    assert!(learner.is_finite());
    let report = learner.step(&unrolls(1).minibatch()).unwrap().to_values();
    assert_eq!(report.skipped, 0, "all numbers of the step itself are finite");
    assert!(!learner.is_finite());
}

/// A task of one step. The reward is higher if the action is nearer to a target.
fn reach(learner: &VmpoLearner, seed: u64) -> (Unrolls, f32) {
    const TARGET: [f32; 3] = [0.6, -0.5, 0.0];
    let mut unrolls = Unrolls::random(seed, 48);
    unrolls.behave(learner, 48 * LENGTH);
    let noise = Numbers::new(seed + 1).take(unrolls.mean.len());
    for (index, action) in unrolls.action.iter_mut().enumerate() {
        *action = unrolls.mean[index] + unrolls.std[index] * 1.7 * noise[index];
    }
    unrolls.discount.fill(0.0);
    let mut total = 0.0;
    for (row, action) in unrolls.action.chunks_exact(3).enumerate() {
        let distance: f32 = action.iter().zip(TARGET).map(|(action, target)| (action - target).powi(2)).sum();
        unrolls.reward[row * 2] = -distance;
        unrolls.reward[row * 2 + 1] = 0.0;
        total -= distance;
    }
    let rows = unrolls.valid.len() as f32;
    (unrolls, total / rows)
}

#[test]
fn rewarded_actions_become_likelier() {
    let mut experiment = training();
    experiment.network.initial_std = 0.4;
    experiment.vmpo.epsilon_mean = 1.0;
    let mut learner = learner(&experiment, 1);
    let (_, before) = reach(&learner, 0);
    for seed in 0..60 {
        let (unrolls, _) = reach(&learner, seed);
        let minibatch = unrolls.minibatch();
        for _ in 0..4 {
            assert!(learner.step(&minibatch).unwrap().to_values().is_finite());
        }
    }
    let (_, after) = reach(&learner, 0);
    // The noise remains at best: three dimensions of variance σ².
    assert!(after > 0.5 * before, "mean reward went from {before} to {after}");
}

#[test]
fn the_value_function_learns_its_targets() {
    let mut learner = learner(&training(), 1);
    let minibatch = unrolls(1).minibatch();
    let first = learner.step(&minibatch).unwrap().to_values();
    for _ in 0..300 {
        learner.step(&minibatch).unwrap();
    }
    let last = learner.step(&minibatch).unwrap().to_values();
    assert!(last.get("value_loss").unwrap() < 0.2 * first.get("value_loss").unwrap(), "{first:?} {last:?}");
    let explained = last.get("variance_explained").unwrap();
    assert!(explained > 0.6 && explained <= 1.0, "{last:?}");
}
