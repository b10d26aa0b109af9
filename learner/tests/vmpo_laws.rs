//! Laws of a whole V-MPO step.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

mod vmpo_support;

use comic_experiment::Prior;
use comic_learner::algorithm::Algorithm as _;
use comic_learner::algorithm::error::Error;
use comic_learner::algorithm::loss_report::Losses;
use comic_learner::algorithm::minibatch::MinibatchTensors;
use comic_learner::vmpo::MULTIPLIER_FLOOR;
use proptest::prelude::*;
use tch::Device;
use vmpo_support::{LENGTH, UNROLLS, Unrolls, difference, experiment, learner, state, values};

/// Unrolls with a termination, a truncation, and an episode of a single step between two ends.
fn unrolls(seed: u64) -> Unrolls {
    Unrolls::random(seed, UNROLLS).end_episode(0, 3, true).end_episode(1, 5, false).end_episode(1, 7, true)
}

#[test]
fn kl_to_an_unchanged_policy_is_exactly_zero_with_equal_batch_shapes() {
    let mut learner = learner(&experiment(), 1);
    let mut unrolls = unrolls(2);
    unrolls.behave(&learner, UNROLLS * LENGTH);
    let losses = learner.step(&unrolls.minibatch()).unwrap().to_values();
    // Rows without a transition are blanked to another distribution, and still do not count.
    assert_eq!((losses.get("kl_mean"), losses.get("kl_std")), (Some(0.0), Some(0.0)));
}

#[test]
fn kl_to_an_unchanged_policy_is_zero_to_1e_6_with_other_batch_shapes() {
    let mut learner = learner(&experiment(), 1);
    let mut unrolls = unrolls(2);
    unrolls.behave(&learner, 5);
    let losses = learner.step(&unrolls.minibatch()).unwrap().to_values();
    assert!(losses.get("kl_mean").unwrap().abs() < 1e-6 && losses.get("kl_std").unwrap().abs() < 1e-6, "{losses:?}");
}

#[test]
fn a_changed_policy_has_a_kl() {
    let mut learner = learner(&experiment(), 1);
    let mut unrolls = unrolls(2);
    unrolls.behave(&learner, UNROLLS * LENGTH);
    let minibatch = unrolls.minibatch();
    learner.step(&minibatch).unwrap();
    let losses = learner.step(&minibatch).unwrap().to_values();
    assert!(losses.get("kl_mean").unwrap() > 0.0 && losses.get("kl_std").unwrap() > 0.0, "{losses:?}");
}

/// Steps two learners, one on each minibatch, and returns the difference of their states.
fn compare(left: &MinibatchTensors, right: &MinibatchTensors) -> f64 {
    let mut experiment = experiment();
    experiment.network.latent.prior = Prior::Ar1 { alpha: 0.95 };
    experiment.vmpo.entropy = 0.01;
    let (mut one, mut other) = (learner(&experiment, 1), learner(&experiment, 1));
    one.step(left).unwrap();
    other.step(right).unwrap();
    difference(&one, &other)
}

#[test]
fn the_contents_of_a_row_without_a_transition_change_nothing() {
    let base = unrolls(3);
    let mut other = base.clone();
    for (row, valid) in base.valid.iter().enumerate().filter(|(_, valid)| **valid == 0.0) {
        assert_eq!(*valid, 0.0);
        for (field, width) in [
            (&mut other.action, 3),
            (&mut other.mean, 3),
            (&mut other.reward, 2),
            (&mut other.previous_latent, 2),
            (&mut other.latent_noise, 2),
            (&mut other.discount, 1),
        ] {
            field[row * width..(row + 1) * width].fill(1e30);
        }
        other.std[row * 3..(row + 1) * 3].fill(0.0);
    }
    assert_eq!(compare(&base.minibatch(), &other.minibatch()), 0.0);
}

#[test]
fn the_last_observation_of_a_terminated_episode_changes_nothing() {
    let base = unrolls(3);
    let mut other = base.clone();
    let row = 3; // of unroll 0
    other.proprioception[row * 5..(row + 1) * 5].fill(0.7);
    other.task[row * 4..(row + 1) * 4].fill(-0.7);
    assert!(compare(&base.minibatch(), &other.minibatch()) < 1e-6);
}

#[test]
fn a_truncated_episode_is_bootstrapped_from_its_last_observation() {
    let base = unrolls(3);
    let mut other = base.clone();
    let row = LENGTH + 1 + 5; // row 5 of unroll 1
    other.proprioception[row * 5..(row + 1) * 5].fill(0.7);
    assert!(compare(&base.minibatch(), &other.minibatch()) > 1e-4);
}

#[test]
fn an_unroll_of_masked_rows_only_changes_nothing() {
    let base = unrolls(4);
    let padding = Unrolls::random(5, 1);
    let mut padded = base.clone();
    padded.count += 1;
    padded.proprioception.extend(padding.proprioception);
    padded.task.extend(padding.task);
    padded.previous_latent.extend(padding.previous_latent);
    padded.latent_noise.extend(padding.latent_noise);
    padded.action.extend(padding.action);
    padded.mean.extend(padding.mean);
    padded.std.extend(padding.std);
    padded.reward.extend(padding.reward);
    padded.discount.extend(padding.discount);
    padded.valid.extend([0.0; LENGTH]);
    padded.first.extend(padding.first);
    padded.clip.extend(padding.clip);
    padded.tasks.extend(padding.tasks);
    assert!(compare(&base.minibatch(), &padded.minibatch()) < 1e-6);
}

#[test]
fn a_batch_without_a_transition_gives_finite_losses() {
    let mut learner = learner(&experiment(), 1);
    let mut unrolls = unrolls(6);
    unrolls.valid.fill(0.0);
    let losses = learner.step(&unrolls.minibatch()).unwrap().to_values();
    assert!(losses.is_finite(), "{losses:?}");
    assert!(state(&learner).iter().all(|(_, values)| values.iter().all(|value| value.is_finite())));
}

#[test]
fn the_mean_action_follows_the_simulators_derivative() {
    let mut experiment = experiment();
    experiment.vmpo.action_gradient = 100.0;
    let mut unrolls = unrolls(2);
    unrolls.behave(&learner(&experiment, 1), UNROLLS * LENGTH);
    // One entry of the action pays, and another one costs.
    let mean_change = |gradient: [f32; 3]| {
        let mut unrolls = unrolls.clone();
        unrolls.action_gradient = gradient.repeat(UNROLLS * LENGTH);
        let mut learner = learner(&experiment, 1);
        learner.step(&unrolls.minibatch()).unwrap();
        let mut after = unrolls.clone();
        after.behave(&learner, UNROLLS * LENGTH);
        let rows = after.mean.chunks_exact(3).zip(unrolls.mean.chunks_exact(3));
        let change = |entry: usize| rows.clone().map(|(after, before)| after[entry] - before[entry]).sum::<f32>();
        [change(0), change(1)]
    };
    let [without, with] = [mean_change([0.0; 3]), mean_change([1.0, -1.0, 0.0])];
    assert!(with[0] > without[0] && with[1] < without[1], "{without:?} {with:?}");
}

#[test]
fn a_clipped_action_would_be_scored_differently() {
    // The policy is trained on the action that was sampled, without clipping. Only the simulator gets the clipped one.
    let base = unrolls(7);
    let loss = |size: f32| {
        let mut unrolls = base.clone();
        unrolls.action.fill(size);
        learner(&experiment(), 1).step(&unrolls.minibatch()).unwrap().to_values().get("policy_loss").unwrap()
    };
    assert!(loss(3.0) > loss(1.0) + 1.0);
}

#[test]
fn a_clip_index_is_refused_if_the_task_has_fewer_clips() {
    let mut learner = learner(&experiment(), 1);
    let before = state(&learner);
    let mut unrolls = unrolls(8);
    unrolls.clip[4] = 3;
    assert!(matches!(learner.step(&unrolls.minibatch()), Err(Error::Shape { clips: 4, known: 3, .. })));
    assert_eq!(state(&learner), before);
}

#[test]
fn a_field_of_the_wrong_length_is_named() {
    let unrolls = unrolls(8);
    let mut shape = unrolls.shape();
    shape.unroll.reward_terms += 1;
    let error = MinibatchTensors::new(&unrolls.arrays(), &unrolls.tasks, &shape, Device::Cpu).unwrap_err();
    assert!(matches!(error, Error::Length { field: "reward", .. }));
}

#[test]
fn a_selection_holds_the_unrolls_asked_for() {
    let unrolls = unrolls(9);
    let whole = unrolls.minibatch();
    let every: Vec<usize> = (0..UNROLLS).collect();
    assert_eq!(compare(&whole, &whole.select(&every)), 0.0);
    assert_eq!(whole.select(&[4, 1]).shape().unrolls, 2);
    assert!(compare(&whole, &whole.select(&[4, 1])) > 0.0);
}

#[test]
fn the_report_of_several_steps_is_their_mean() {
    let minibatch = unrolls(10).minibatch();
    let mut learner = learner(&experiment(), 1);
    let steps: Vec<Losses> = (0..3).map(|_| learner.step(&minibatch).unwrap()).collect();
    let mean = Losses::mean(&steps).unwrap().to_values();
    for (name, value) in mean.entries() {
        let expected = steps.iter().map(|step| step.to_values().get(name).unwrap()).sum::<f32>() / 3.0;
        assert!((value - expected).abs() <= 1e-5 * expected.abs().max(1.0), "{name}");
    }
    assert!(Losses::mean(&[]).is_none());
}

#[test]
fn gradients_are_clipped_only_when_asked() {
    let minibatch = unrolls(11).minibatch();
    let moved = |limit: f64| {
        let mut experiment = experiment();
        experiment.optimiser.max_gradient_norm = limit;
        let mut learner = learner(&experiment, 1);
        let before = values(&learner.policy_store().variables()["encoder.tracking.head.weight"].detach().copy());
        let norm = f64::from(learner.step(&minibatch).unwrap().to_values().get("gradient_norm").unwrap());
        let after = values(&learner.policy_store().variables()["encoder.tracking.head.weight"].detach());
        (norm, before.iter().zip(after).map(|(before, after)| (before - after).abs()).fold(0.0, f32::max))
    };
    let (norm, free) = moved(0.0);
    assert_eq!(moved(norm * 2.0), (norm, free));
    let (reported, held) = moved(norm / 1e4);
    assert_eq!(reported, norm, "the norm is reported as it was before clipping");
    assert!(held < free / 1e3, "{held} {free}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn permuting_a_batch_changes_nothing(seed in 0u64..1000, order in Just((0..UNROLLS).collect::<Vec<_>>()).prop_shuffle()) {
        let mut unrolls = unrolls(seed);
        // The gradient of the value's bias is the mean error. Without this, errors of both signs can cancel and leave their rounding.
        unrolls.reward.iter_mut().for_each(|reward| *reward -= 0.2);
        let minibatch = unrolls.minibatch();
        let permuted = minibatch.select(&order);
        prop_assert!(compare(&minibatch, &permuted) < 2e-6);
    }

    #[test]
    fn multipliers_stay_at_least_1e_8(seed in 0u64..1000, rate in 0.0f64..100.0) {
        let mut experiment = experiment();
        experiment.optimiser.epsilon = 1e-8;
        experiment.optimiser.learning_rate = 1e-4;
        experiment.optimiser.multiplier_learning_rate = rate.max(1e-6);
        let mut learner = learner(&experiment, 1);
        let mut unrolls = unrolls(seed);
        // The KLs are far below their limits, so α falls as fast as it can.
        unrolls.behave(&learner, UNROLLS * LENGTH);
        let minibatch = unrolls.minibatch();
        for _ in 0..4 {
            prop_assert!(learner.step(&minibatch).unwrap().to_values().is_finite());
            let multipliers = values(&learner.multipliers().parameter().detach());
            prop_assert!(multipliers.iter().all(|value| *value >= MULTIPLIER_FLOOR as f32), "{multipliers:?}");
        }
    }
}
