//! SVG(0): its laws.
#![allow(clippy::unwrap_used, reason = "helpers of tests may panic")]

mod svg0_support;

use std::collections::HashMap;

use comic_learner::algorithm::Algorithm as _;
use comic_proto::Field;
use svg0_support::{GENERATOR, SEQUENCES, Sequences, after_step, experiment, largest_difference, learner};
use tch::Tensor;

#[test]
fn rows_of_the_burn_in_and_without_a_transition_teach_nothing() {
    let _guard = GENERATOR.lock().unwrap();
    let experiment = experiment();
    let sequences = Sequences::new(&experiment, SEQUENCES, 1).end_episode(1, 4, true);
    let mut changed = sequences.clone();
    for field in [Field::Action, Field::Mean, Field::Reward] {
        // What was decided in rows of the burn-in, and in the row of a last observation.
        changed.row(field, 0, 1).fill(9.0);
        changed.row(field, 1, 4).fill(-9.0);
    }
    let (one, other) = (after_step(&experiment, &sequences), after_step(&experiment, &changed));
    assert_eq!(largest_difference(&one, &other, ""), 0.0);
    let mut learned = sequences;
    learned.row(Field::Reward, 0, 3).fill(9.0);
    assert!(largest_difference(&one, &after_step(&experiment, &learned), "policy.core") > 1e-6);
}

#[test]
fn a_failure_is_not_bootstrapped_and_a_truncation_is() {
    let _guard = GENERATOR.lock().unwrap();
    let experiment = experiment();
    let sequences = Sequences::new(&experiment, SEQUENCES, 2);
    // The observation after the episode's last step decides what a truncated episode is still worth.
    let moved = |terminated| {
        let one = sequences.clone().end_episode(1, 5, terminated);
        let mut other = one.clone();
        other.row(Field::Task, 1, 5).fill(3.0);
        let (one, other) = (after_step(&experiment, &one), after_step(&experiment, &other));
        largest_difference(&one, &other, "policy.") + largest_difference(&one, &other, "value.")
    };
    assert_eq!(moved(true), 0.0);
    assert!(moved(false) > 1e-7);
}

#[test]
fn the_critic_alone_trains_the_core() {
    let _guard = GENERATOR.lock().unwrap();
    let experiment = experiment();
    let sequences = Sequences::new(&experiment, SEQUENCES, 3);
    let one = after_step(&experiment, &sequences);
    // Another weight of the entropy changes the policy's loss only. (Its KL to the prior is part of the critic's targets.)
    let mut other = experiment.clone();
    other.svg0.entropy = 1.0;
    let other = after_step(&other, &sequences);
    assert_eq!(largest_difference(&one, &other, "policy.core"), 0.0);
    assert_eq!(largest_difference(&one, &other, "value."), 0.0);
    assert!(largest_difference(&one, &other, "policy.latent_policy") > 1e-6);
}

#[test]
fn the_target_is_a_copy_bit_for_bit_every_so_many_steps() {
    let _guard = GENERATOR.lock().unwrap();
    let mut experiment = experiment();
    experiment.svg0.target_period = 3;
    let sequences = Sequences::new(&experiment, SEQUENCES, 4).tensors();
    let mut learner = learner(&experiment);
    let initial: HashMap<String, Tensor> = learner.state().into_iter().collect();
    for step in 1..=6 {
        learner.step(&sequences).unwrap();
        let state: HashMap<String, Tensor> = learner.state().into_iter().collect();
        for (name, target) in state.iter().filter_map(|(name, tensor)| Some((name.strip_prefix("target_")?, tensor))) {
            match step % 3 {
                0 => assert_eq!(target, &state[name], "{name} after {step} steps"),
                _ if step < 3 => assert_eq!(target, &initial[&format!("target_{name}")], "{name} after {step} steps"),
                _ => {}
            }
        }
    }
}

#[test]
fn state_and_minibatches_decide_every_later_parameter() {
    let _guard = GENERATOR.lock().unwrap();
    let experiment = experiment();
    let minibatches: Vec<_> = (0..6).map(|seed| Sequences::new(&experiment, SEQUENCES, seed).tensors()).collect();
    let mut whole = learner(&experiment);
    minibatches.iter().for_each(|minibatch| drop(whole.step(minibatch).unwrap()));
    let mut first = learner(&experiment);
    minibatches[..3].iter().for_each(|minibatch| drop(first.step(minibatch).unwrap()));
    let mut resumed = learner(&experiment);
    resumed.load_state(&first.state()).unwrap();
    minibatches[3..].iter().for_each(|minibatch| drop(resumed.step(minibatch).unwrap()));
    let [one, other] = [whole.state(), resumed.state()].map(|state| state.into_iter().collect::<HashMap<_, _>>());
    assert_eq!(largest_difference(&one, &other, ""), 0.0);
}
