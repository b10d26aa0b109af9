//! SVG(0): its laws.
#![allow(clippy::unwrap_used, reason = "helpers of tests may panic")]

mod svg0_support;

use std::collections::HashMap;

use comic_experiment::Experiment;
use comic_learner::algorithm::Algorithm as _;
use comic_learner::svg0::Svg0Learner;
use comic_networks::{Policy as _, RecurrentState, Routing, Svg0Policy, from_safetensors};
use comic_proto::Field;
use svg0_support::{
    GENERATOR, LENGTH, SEQUENCES, Sequences, after_step, experiment, largest_difference, learner, spec,
};
use tch::{Device, Kind, Tensor, nn};

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
fn a_step_that_is_not_finite_changes_nothing() {
    let _guard = GENERATOR.lock().unwrap();
    let mut experiment = experiment();
    experiment.svg0.target_period = 2;
    let good = Sequences::new(&experiment, SEQUENCES, 4);
    let mut bad = good.clone();
    bad.row(Field::Reward, 1, 4).fill(f32::NAN);
    let [good, bad] = [good, bad].map(|sequences| sequences.tensors());
    let mut learner = learner(&experiment);
    learner.step(&good).unwrap();
    let state = |learner: &Svg0Learner| {
        let mut state: HashMap<String, Tensor> = learner.state().into_iter().collect();
        // It decides the next step's noise.
        assert!(state.remove("gradient_steps").is_some());
        state
    };
    let before = state(&learner);
    // It would be the second step, after which the target is renewed.
    assert_eq!(learner.step(&bad).unwrap().to_values().skipped, 1);
    for (name, tensor) in state(&learner) {
        assert_eq!(tensor, before[&name], "{name}");
    }
    learner.step(&good).unwrap();
    let after = state(&learner);
    assert_eq!(after["target_value.head.weight"], after["value.head.weight"]);
    assert_ne!(after["value.head.weight"], before["value.head.weight"]);
}

/// A large error of the critic does not shrink the policy's step.
#[test]
fn critic_and_policy_are_clipped_apart() {
    let _guard = GENERATOR.lock().unwrap();
    let mut experiment = experiment();
    experiment.optimiser.max_gradient_norm = 1e-3;
    let sequences = Sequences::new(&experiment, SEQUENCES, 6);
    let mut surprising = sequences.clone();
    surprising.row(Field::Reward, 0, 4).fill(100.0);
    let [one, other] = [sequences, surprising].map(|sequences| after_step(&experiment, &sequences));
    assert!(largest_difference(&one, &other, "value.") > 1e-9);
    assert_eq!(largest_difference(&one, &other, "policy.latent_policy"), 0.0);
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

/// The sequences as an actor with the learner's policy plays them, row by row, from a state that it has after a row before them.
fn acted(learner: &Svg0Learner, experiment: &Experiment, mut sequences: Sequences) -> Sequences {
    let mut store = nn::VarStore::new(Device::Cpu);
    let policy = Svg0Policy::new(&store.root(), &spec(), experiment);
    from_safetensors(&mut store, &learner.policy_parameters().unwrap()).unwrap();
    let none = Tensor::zeros([1, 0], (Kind::Float, Device::Cpu));
    for sequence in 0..SEQUENCES {
        let mut state = Tensor::from_slice(sequences.row(Field::State, sequence, 0)).unsqueeze(0);
        // Row −1 has the observation of row 0.
        for t in -1..LENGTH as i64 {
            let row = t.max(0) as usize;
            if t == 0 {
                sequences
                    .row(Field::State, sequence, 0)
                    .copy_from_slice(&Vec::<f32>::try_from(state.view(-1)).unwrap());
            }
            if t >= 0 && sequences.row(Field::First, sequence, row)[0] == 1.0 {
                state = state.zeros_like();
            }
            let [proprioception, task] = [Field::Proprioception, Field::Task]
                .map(|field| Tensor::from_slice(sequences.row(field, sequence, row)).unsqueeze(0));
            let observation = policy.normalise(&proprioception, &task, None, &Routing::single());
            let acting = policy.act(&observation, &none, &none, RecurrentState { state: &state, first: None });
            let (mean, std, _) = acting.action.to_rows();
            let action = &mean + &std * Tensor::randn_like(&mean);
            for (field, values) in [(Field::Mean, mean), (Field::Std, std), (Field::Action, action)] {
                sequences.row(field, sequence, row).copy_from_slice(&Vec::<f32>::try_from(values.view(-1)).unwrap());
            }
            state = acting.state;
        }
    }
    sequences
}

/// Also that the actor's recurrent steps are the learner's pass, over a burn-in and the beginnings of episodes.
#[test]
fn on_policy_nothing_is_cut() {
    let _guard = GENERATOR.lock().unwrap();
    let mut experiment = experiment();
    let sequences = Sequences::new(&experiment, SEQUENCES, 5).end_episode(1, 4, true).end_episode(2, 1, false);
    for lambda in [1.0, 0.5] {
        experiment.svg0.lambda = lambda;
        let mut learner = learner(&experiment);
        let mut on_policy = tch::no_grad(|| acted(&learner, &experiment, sequences.clone()));
        let trace = |learner: &mut Svg0Learner, sequences: &Sequences| {
            f64::from(learner.step(&sequences.tensors()).unwrap().to_values().get("trace").unwrap())
        };
        let found = trace(&mut learner, &on_policy);
        assert!((found - lambda).abs() < 1e-5, "the mean trace is {found}");
        // One action of one sequence as the likeliest of a policy with half the deviation: four times as likely, or more.
        let action = on_policy.row(Field::Action, 0, 3).to_vec();
        on_policy.row(Field::Mean, 0, 3).copy_from_slice(&action);
        on_policy.row(Field::Std, 0, 3).iter_mut().for_each(|std| *std *= 0.5);
        let mut learner = svg0_support::learner(&experiment);
        let found = trace(&mut learner, &on_policy);
        assert!(found < 0.96 * lambda, "the mean trace is {found}");
    }
}
