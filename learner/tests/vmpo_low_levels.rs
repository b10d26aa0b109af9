//! Every low level with the same learner: acting step by step equals learning on the whole unroll, and V-MPO depends on
//! nothing that it must not depend on.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

mod vmpo_support;

use std::collections::BTreeMap;

use comic_experiment::{Experiment, LowLevelName, Lstm, Primitives, Prior};
use comic_learner::algorithm::Algorithm as _;
use comic_learner::algorithm::minibatch::MinibatchTensors;
use comic_learner::vmpo::VmpoLearner;
use comic_networks::{Policy as _, RecurrentState, Routing};
use tch::{Device, Kind, Tensor};
use vmpo_support::{LENGTH, Numbers, Unrolls, assert_close, difference, experiment, learner};

/// Every low level, the gated ones with a bottleneck and without.
fn every_low_level() -> Vec<(&'static str, Experiment)> {
    let of = |name: LowLevelName, bottleneck: bool| {
        let mut experiment = experiment();
        let network = &mut experiment.network;
        network.low_level = name;
        network.lstm = Lstm { units: vec![6, 5] };
        network.primitives = Primitives { count: 3, torso: vec![8], hidden: 6, gate: vec![7], biases: true };
        if name == LowLevelName::Lstm {
            network.value_lstm = vec![6];
        }
        if !bottleneck {
            network.latent.size = 0;
        }
        experiment
    };
    vec![
        ("mlp", of(LowLevelName::Mlp, true)),
        ("lstm", of(LowLevelName::Lstm, true)),
        ("mixture", of(LowLevelName::Mixture, true)),
        ("mixture without a bottleneck", of(LowLevelName::Mixture, false)),
        ("product", of(LowLevelName::Product, true)),
        ("product without a bottleneck", of(LowLevelName::Product, false)),
    ]
}

/// The actions of a policy, step by step.
struct Acted {
    unrolls: Unrolls,
    /// z_t, unroll by unroll.
    latents: Vec<f32>,
    /// The recurrent state after the last step, `[B, S]`.
    state: Tensor,
}

fn unrolls(learner: &VmpoLearner, experiment: &Experiment, seed: u64) -> Unrolls {
    acted(learner, experiment, seed).unrolls
}

/// Unrolls that this learner's own policy makes, acting step by step. In the first one an episode ends and another begins;
/// every unroll starts in the middle of an episode.
fn acted(learner: &VmpoLearner, experiment: &Experiment, seed: u64) -> Acted {
    let count = 3;
    let mut unrolls = Unrolls::random(seed, count).end_episode(0, 3, true).end_episode(1, 5, false);
    let (latent, state) = (experiment.network.latent.size, experiment.network.state_size());
    let mut numbers = Numbers::new(seed + 100);
    unrolls.latent_noise = numbers.take(count * LENGTH * latent);
    unrolls.state = numbers.take(count * state);
    let mut recurrent_state = Tensor::from_slice(&unrolls.state).reshape([count as i64, state as i64]);
    let mut previous = Tensor::from_slice(&numbers.take(count * latent)).reshape([count as i64, latent as i64]);
    let rows = |values: &[f32], length: usize, t: usize| {
        let width = values.len() / (count * length);
        let tensor = Tensor::from_slice(values).reshape([count, length, width].map(|size| size as i64));
        tensor.select(1, t as i64)
    };
    // Per step, [count, ·]; put in unroll order at the end.
    let (mut means, mut stds, mut weights) = (Vec::new(), Vec::new(), Vec::new());
    let (mut previous_latents, mut latents) = (Vec::new(), Vec::new());
    for t in 0..LENGTH {
        let begins = rows(&unrolls.first, LENGTH + 1, t);
        previous = (1.0 - &begins) * previous;
        recurrent_state = (1.0 - begins) * recurrent_state;
        previous_latents.push(previous.copy());
        let acting = comic_networks::acting(|| {
            let observation = learner.policy().normalise(
                &rows(&unrolls.proprioception, LENGTH + 1, t),
                &rows(&unrolls.task, LENGTH + 1, t),
                None,
                &Routing::single(),
            );
            let recurrent = RecurrentState { state: &recurrent_state, first: None };
            learner.policy().act(&observation, &previous, &rows(&unrolls.latent_noise, LENGTH, t), recurrent)
        });
        let (mean, std, log_weights) = acting.action.to_rows();
        (previous, recurrent_state) = (acting.latent, acting.state);
        latents.push(previous.copy());
        means.push(mean);
        stds.push(std);
        weights.extend(log_weights);
    }
    let unrolled = |steps: &[Tensor]| match steps {
        [] => Vec::new(),
        steps => Vec::<f32>::try_from(Tensor::stack(steps, 1).flatten(0, -1).contiguous()).unwrap(),
    };
    (unrolls.mean, unrolls.std) = (unrolled(&means), unrolled(&stds));
    (unrolls.log_weights, unrolls.previous_latent) = (unrolled(&weights), unrolled(&previous_latents));
    Acted { unrolls, latents: unrolled(&latents), state: recurrent_state }
}

fn minibatch(learner: &VmpoLearner, experiment: &Experiment, seed: u64) -> MinibatchTensors {
    unrolls(learner, experiment, seed).minibatch()
}

#[test]
fn acting_step_by_step_is_acting_on_the_whole_unroll() {
    for (name, experiment) in every_low_level() {
        let learner = learner(&experiment, 1);
        let Acted { unrolls, latents, state } = acted(&learner, &experiment, 2);
        let acting = unrolls.act_at_once(&learner, &experiment, &Routing::single());
        unrolls.assert_decided(name, &acting);
        assert_close(&format!("{name}: latent"), &acting.latent, &Tensor::from_slice(&latents));
        assert_close(&format!("{name}: state"), &acting.state, &state);
    }
}

#[test]
fn a_prior_of_the_state_is_learned_in_the_latents_kl() {
    let (_, mut experiment) = every_low_level().remove(0);
    experiment.network.latent.prior = Prior::State { hidden: vec![6] };
    experiment.network.latent.beta = 1.0;
    let mut learner = learner(&experiment, 1);
    let Acted { unrolls, latents, .. } = acted(&learner, &experiment, 2);
    let acting = unrolls.act_at_once(&learner, &experiment, &Routing::single());
    assert_close("latent", &acting.latent, &Tensor::from_slice(&latents));
    let kl = acting.latent_posterior.unwrap().kl(&acting.latent_prior.unwrap());
    let valid = Tensor::from_slice(&unrolls.valid);
    let expected = ((kl * &valid).sum(Kind::Double) / valid.sum(Kind::Double)).double_value(&[]);
    let before: Vec<Tensor> = prior_of(&learner).into_values().map(|tensor| tensor.detach().copy()).collect();
    assert!(!before.is_empty());
    let losses = learner.step(&unrolls.minibatch()).unwrap().to_values();
    let found = f64::from(losses.get("latent_kl").unwrap());
    assert!((found - expected).abs() < 1e-5 * expected, "{found} is not {expected}");
    for ((name, tensor), before) in prior_of(&learner).into_iter().zip(before) {
        let moved = (tensor - before).abs();
        assert!(moved.max().double_value(&[]) > 0.0, "{name} does not learn");
        if name == "prior.head.bias" {
            // The second half makes σ, which only the KL reaches.
            let half = moved.size()[0] / 2;
            assert!(moved.narrow(0, half, half).min().double_value(&[]) > 0.0, "the KL does not train the prior");
        }
    }
}

/// The parameters of the prior by name.
fn prior_of(learner: &VmpoLearner) -> BTreeMap<String, Tensor> {
    learner.policy_store().variables().into_iter().filter(|(name, _)| name.starts_with("prior.")).collect()
}

#[test]
fn the_acting_policy_is_the_one_that_is_learnt_from() {
    for (name, experiment) in every_low_level() {
        let mut learner = learner(&experiment, 1);
        let losses = learner.step(&minibatch(&learner, &experiment, 2)).unwrap().to_values();
        // Nothing has changed since the policy acted, so every KL is 0.
        for kl in ["kl_mean", "kl_std", "kl_weights"].map(|kl| losses.get(kl).unwrap()) {
            assert!(kl.abs() < 1e-5, "{name}: {losses:?}");
        }
    }
}

#[test]
fn a_wrong_recurrent_state_is_noticed() {
    let (_, experiment) = every_low_level().remove(1);
    let mut learner = learner(&experiment, 1);
    let mut unrolls = unrolls(&learner, &experiment, 2);
    unrolls.state.iter_mut().for_each(|number| *number = -*number);
    let losses = learner.step(&unrolls.minibatch()).unwrap().to_values();
    assert!(losses.get("kl_mean").unwrap() > 1e-5, "{losses:?}");
}

#[test]
fn a_changed_policy_has_a_kl_in_every_part_and_multipliers_that_move() {
    for (name, experiment) in every_low_level() {
        let mut learner = learner(&experiment, 1);
        let minibatch = minibatch(&learner, &experiment, 2);
        let before = learner.multipliers().parameter().copy();
        learner.step(&minibatch).unwrap();
        let losses = learner.step(&minibatch).unwrap().to_values();
        assert!(losses.get("kl_mean").unwrap() > 0.0 && losses.get("kl_std").unwrap() > 0.0, "{name}: {losses:?}");
        let mixture = name.starts_with("mixture");
        assert_eq!(losses.get("kl_weights").unwrap() > 0.0, mixture, "{name}: {losses:?}");
        let moved = (learner.multipliers().parameter() - before).abs().min().double_value(&[]);
        assert_eq!(learner.multipliers().parameter().size(), [if mixture { 4 } else { 3 }]);
        assert!(moved > 0.0, "{name}");
    }
}

/// Steps two learners, one on each minibatch, and returns the difference of their states.
fn compare(experiment: &Experiment, left: &MinibatchTensors, right: &MinibatchTensors) -> f64 {
    let (mut one, mut other) = (learner(experiment, 1), learner(experiment, 1));
    one.step(left).unwrap();
    other.step(right).unwrap();
    difference(&one, &other)
}

#[test]
fn permuting_the_batch_changes_nothing() {
    for (name, experiment) in every_low_level() {
        let base = minibatch(&learner(&experiment, 1), &experiment, 3);
        let permuted = base.select(&[2, 0, 1]);
        assert!(compare(&experiment, &base, &permuted) < 1e-5, "{name}");
    }
}

#[test]
fn the_contents_of_a_row_without_a_transition_change_nothing() {
    for (name, experiment) in every_low_level() {
        let base = unrolls(&learner(&experiment, 1), &experiment, 3);
        let mut other = base.clone();
        for row in base.valid.iter().enumerate().filter(|(_, valid)| **valid == 0.0).map(|(row, _)| row) {
            let rows = base.valid.len();
            for field in [&mut other.mean, &mut other.log_weights, &mut other.latent_noise, &mut other.action] {
                let width = field.len() / rows;
                field[row * width..(row + 1) * width].fill(1e30);
            }
            let width = other.std.len() / rows;
            other.std[row * width..(row + 1) * width].fill(0.0);
        }
        assert_eq!(compare(&experiment, &base.minibatch(), &other.minibatch()), 0.0, "{name}");
    }
}

#[test]
fn a_policy_uses_nothing_from_before_its_episode() {
    for (name, experiment) in every_low_level() {
        let learner = learner(&experiment, 1);
        let base = unrolls(&learner, &experiment, 4);
        let mut other = base.clone();
        // Unroll 0 ends an episode in row 3: the rows before have no influence on rows 4 and later.
        other.proprioception[..3 * 5].fill(0.9);
        other.task[..3 * 4].fill(-0.9);
        let state = other.state.len() / other.count;
        other.state[..state].fill(0.3);
        let means = |unrolls: &Unrolls| {
            let count = unrolls.count as i64;
            let tensor = |values: &[f32], length: usize| {
                Tensor::from_slice(values).reshape([
                    count,
                    length as i64,
                    (values.len() / unrolls.count / length) as i64,
                ])
            };
            let observation = learner.policy().normalise(
                &tensor(&unrolls.proprioception, LENGTH + 1).narrow(1, 0, LENGTH as i64),
                &tensor(&unrolls.task, LENGTH + 1).narrow(1, 0, LENGTH as i64),
                None,
                &Routing::single(),
            );
            let state = Tensor::from_slice(&unrolls.state).reshape([count, state as i64]);
            let first = tensor(&unrolls.first, LENGTH + 1).squeeze_dim(-1).narrow(1, 0, LENGTH as i64);
            let previous = tensor(&unrolls.previous_latent, LENGTH);
            let noise = tensor(&unrolls.latent_noise, LENGTH);
            let recurrent = RecurrentState { state: &state, first: Some(&first) };
            learner.policy().act(&observation, &previous, &noise, recurrent).action.mean()
        };
        let change = (means(&base) - means(&other)).abs().amax([-1], false);
        let largest = |from: i64, rows: i64| change.narrow(0, from, rows).max().double_value(&[]);
        assert!(largest(0, 3) > 1e-4, "{name}: the rows that were changed");
        assert_eq!(largest(4, LENGTH as i64 - 4), 0.0, "{name}");
    }
}

#[test]
fn primitives_never_see_the_reference() {
    for (name, experiment) in every_low_level().into_iter().skip(2) {
        let learner = learner(&experiment, 1);
        let influence = || {
            let zeros = |width: i64| Tensor::zeros([2, width], (Kind::Float, Device::Cpu));
            let reference = zeros(4).set_requires_grad(true);
            let observation = learner.policy().normalise(&zeros(5), &reference, None, &Routing::single());
            let latent = experiment.network.latent.size as i64;
            let recurrent = RecurrentState { state: &zeros(0), first: None };
            let acting = learner.policy().act(&observation, &zeros(latent), &zeros(latent), recurrent);
            let total = acting.action.mean().square().sum(Kind::Float) + acting.action.std().sum(Kind::Float);
            Tensor::run_backward(&[total], &[&reference], false, false)
                .remove(0)
                .abs()
                .sum(Kind::Float)
                .double_value(&[])
        };
        assert!(influence() > 0.0, "{name}: the reference reaches the action");
        // If the weights do not depend on the reference, nothing does.
        let gate = if experiment.network.latent.size > 0 {
            "low_level.gate.head.weight"
        } else {
            "encoder.tracking.head.weight"
        };
        let mut weights = learner.policy_store().variables().remove(gate).unwrap();
        let _ = tch::no_grad(|| weights.zero_());
        assert_eq!(influence(), 0.0, "{name}");
    }
}

#[test]
fn burn_in_rows_are_not_learnt_from_and_the_next_row_is() {
    let (_, mut experiment) = every_low_level().remove(1);
    experiment.vmpo.value_burn_in = 2;
    let base = unrolls(&learner(&experiment, 1), &experiment, 6);
    let changed = |row: usize| {
        let mut other = base.clone();
        let width = other.action.len() / other.valid.len();
        // In unroll 2 no episode ends.
        let start = (2 * LENGTH + row) * width;
        other.action[start..start + width].fill(0.9);
        other.mean[start..start + width].fill(-0.9);
        compare(&experiment, &base.minibatch(), &other.minibatch())
    };
    assert_eq!((changed(0), changed(1)), (0.0, 0.0));
    assert!(changed(2) > 1e-5);
}
