//! SVG(0) on a task whose action values are known.
#![allow(clippy::unwrap_used, reason = "helpers of tests may panic")]

mod svg0_support;

use std::collections::HashMap;

use comic_learner::algorithm::Algorithm as _;
use comic_proto::Field;
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;
use svg0_support::{ACTION, GENERATOR, Sequences, experiment, learner};

/// A draw of N(0, 1), by Box and Muller.
fn normal(random: &mut Pcg64) -> f32 {
    let (radius, angle) = (1.0 - random.random::<f32>(), random.random::<f32>() * std::f32::consts::TAU);
    (-2.0 * radius.ln()).sqrt() * angle.cos()
}

/// Two states, which the first number of the observation tells apart. The action's first entry decides: above 0 the next state is
/// the other one. State 0 pays nothing and state 1 pays 1. The best policy goes to state 1 and stays there.
#[test]
fn the_action_value_of_a_chain_with_two_states_is_learned() {
    let _guard = GENERATOR.lock().unwrap();
    let mut experiment = experiment();
    experiment.unroll.length = 8;
    experiment.optimiser.epsilon = 1e-8;
    experiment.network.min_std = 0.3;
    experiment.network.initial_std = 0.7;
    let svg0 = &mut experiment.svg0;
    (svg0.learning_rate, svg0.target_period, svg0.discount) = (3e-3, 25, 0.8);
    (svg0.entropy, svg0.kl, svg0.burn_in) = (0.0, 0.0, 0);
    // Wide enough for the step between staying and going: an error there is bootstrapped, which multiplies it by 1 / (1 − γ).
    svg0.action_value = vec![64, 64];
    experiment.transfer.mean_scale = 1.0;
    let mut random = Pcg64::seed_from_u64(5);
    let mut learner = learner(&experiment);
    let mut last = HashMap::new();
    for step in 0..3000 {
        if step == 1500 {
            // Smaller steps, so that the estimate settles.
            learner.set_learning_rate(2e-4);
        }
        let mut sequences = Sequences::new(&experiment, 32, random.random());
        for sequence in 0..32 {
            let mut state: bool = random.random();
            sequences.row(Field::State, sequence, 0).fill(0.0);
            for t in 0..=8 {
                sequences.row(Field::Proprioception, sequence, t).copy_from_slice(&[
                    f32::from(u8::from(state)),
                    0.0,
                    0.0,
                ]);
                sequences.row(Field::Task, sequence, t).fill(0.0);
                sequences.row(Field::First, sequence, t)[0] = 1.0;
                if t == 8 {
                    break;
                }
                // The behaviour is N(0, 1).
                let action: [f32; ACTION] = std::array::from_fn(|_| normal(&mut random));
                sequences.row(Field::Action, sequence, t).copy_from_slice(&action);
                sequences.row(Field::Mean, sequence, t).fill(0.0);
                sequences.row(Field::Std, sequence, t).fill(1.0);
                sequences.row(Field::Reward, sequence, t)[0] = f32::from(u8::from(state));
                state ^= action[0] > 0.0;
            }
        }
        let losses = learner.step(&sequences.tensors()).unwrap().to_values();
        for name in ["value_loss", "action_value", "retrace_target"] {
            let value = f64::from(losses.get(name).unwrap());
            let mean = last.entry(name).or_insert(value);
            *mean += 0.01 * (value - *mean);
        }
    }
    // The policy's probability p to do the right thing in each state follows from its bounded mean and least deviation: Φ(1/0.3)
    // is 0.9996. With p = 1, V(1) = 1 / (1 − γ) = 5 and V(0) = γ · 5 = 4. Under the behaviour both states and both actions are
    // equally likely: Q(0, go) = 4, Q(0, stay) = 0.8 · 4 = 3.2, Q(1, stay) = 5, Q(1, go) = 1 + 0.8 · 4 = 4.2; the mean is 4.1.
    let mean = last["action_value"];
    assert!((mean - 4.1).abs() < 0.041, "the mean action value is {mean}: {last:?}");
}
