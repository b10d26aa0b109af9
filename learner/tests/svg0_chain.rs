//! SVG(0) on a task whose action values and best policy are known.
#![allow(clippy::unwrap_used, reason = "helpers of tests may panic")]

mod svg0_support;

use comic_experiment::{Experiment, Svg0};
use comic_learner::algorithm::Algorithm as _;
use comic_learner::svg0::{Networks, losses, noise};
use comic_proto::Field;
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;
use svg0_support::{ACTION, GENERATOR, Sequences, experiment, learner, spec};
use tch::{Device, Kind};

const ROWS: usize = 10;
/// σ of the behaviour, whose mean is 0: it covers the best policy.
const BEHAVIOUR: f32 = 1.5;
const MEAN_SCALE: f64 = 2.0;
const MIN_STD: f64 = 0.3;

/// Entropy and KL weigh so much that every action value would be off by a tenth or more without one of them.
fn chain() -> Experiment {
    let mut experiment = experiment();
    experiment.unroll.length = ROWS;
    experiment.optimiser.epsilon = 1e-8;
    (experiment.optimiser.learning_rate, experiment.optimiser.final_learning_rate_share) = (3e-3, 0.1);
    experiment.transfer.mean_scale = MEAN_SCALE;
    let svg0 = &mut experiment.svg0;
    (svg0.min_std, svg0.initial_std) = (MIN_STD, 0.7);
    (svg0.target_period, svg0.discount) = (25, 0.8);
    (svg0.entropy, svg0.kl, svg0.burn_in) = (0.2, 0.2, 2);
    // Wide enough for the step between staying and going: an error there is bootstrapped, which multiplies it by 1 / (1 − γ).
    svg0.action_value = vec![64, 64];
    experiment
}

/// A draw of N(0, 1), by Box and Muller.
fn normal(random: &mut Pcg64) -> f32 {
    let (radius, angle) = (1.0 - random.random::<f32>(), random.random::<f32>() * std::f32::consts::TAU);
    (-2.0 * radius.ln()).sqrt() * angle.cos()
}

/// Two states, which the first number of the observation tells apart. The action's first entry decides: above 0 the next state is
/// the other one. State 0 pays nothing and state 1 pays 1.
fn play(experiment: &Experiment, count: usize, random: &mut Pcg64) -> Sequences {
    let mut sequences = Sequences::new(experiment, count, random.random());
    for sequence in 0..count {
        let mut state: bool = random.random();
        sequences.row(Field::State, sequence, 0).fill(0.0);
        for t in 0..=ROWS {
            let observation = [f32::from(u8::from(state)), 0.0, 0.0];
            sequences.row(Field::Proprioception, sequence, t).copy_from_slice(&observation);
            sequences.row(Field::Task, sequence, t).fill(0.0);
            if t == ROWS {
                break;
            }
            let action: [f32; ACTION] = std::array::from_fn(|_| BEHAVIOUR * normal(random));
            sequences.row(Field::Action, sequence, t).copy_from_slice(&action);
            sequences.row(Field::Mean, sequence, t).fill(0.0);
            sequences.row(Field::Std, sequence, t).fill(BEHAVIOUR);
            sequences.row(Field::Reward, sequence, t)[0] = f32::from(u8::from(state));
            state ^= action[0] > 0.0;
        }
    }
    sequences
}

/// What the losses define, by iteration: Q(s, u) = r + γ V(s′), where V(s) = E Q(s, u) − c_KL KL(π ‖ N(0, I)), under the Gaussian π
/// that maximises E Q + c_H H − c_KL KL. So the entropy moves the policy and is not part of the values.
struct Solution {
    /// Q(s, stay) and Q(s, go).
    action_value: [[f64; 2]; 2],
    /// σ of both entries of the action in each state.
    std: [[f64; 2]; 2],
}

fn solve(config: &Svg0) -> Solution {
    let kl = |mean: f64, std: f64| 0.5 * (mean * mean + std * std - 1.0) - std.ln();
    let gain = |mean: f64, std: f64| config.entropy * std.ln() - config.kl * kl(mean, std);
    let grid = |from: f64, to: f64| (0..=200).map(move |step| from + (to - from) * f64::from(step) / 200.0);
    // Of all candidates (μ, σ) for the first entry: the probability to go, and what else counts.
    let mut candidates = Vec::new();
    for mean in grid(-MEAN_SCALE, MEAN_SCALE) {
        candidates.extend(grid(MIN_STD, 2.0).map(|std| (below(mean / std), gain(mean, std), mean, std)));
    }
    // The second entry does nothing.
    let idle = grid(MIN_STD, 2.0).max_by(|one, other| gain(0.0, *one).total_cmp(&gain(0.0, *other))).unwrap();
    let mut solution = Solution { action_value: [[0.0; 2]; 2], std: [[0.0; 2]; 2] };
    let mut value = [0.0; 2];
    // 0.8⁵⁰ is 1e-5.
    for _ in 0..50 {
        for state in 0..2 {
            let reward = state as f64;
            solution.action_value[state] = [state, 1 - state].map(|next| reward + config.discount * value[next]);
        }
        for (state, value) in value.iter_mut().enumerate() {
            let [stay, go] = solution.action_value[state];
            let worth = |(probability, gain, ..): &(f64, f64, f64, f64)| probability * (go - stay) + gain;
            let best = candidates.iter().max_by(|one, other| worth(one).total_cmp(&worth(other))).unwrap();
            let (probability, _, mean, std) = *best;
            *value = stay + probability * (go - stay) - config.kl * (kl(mean, std) + kl(0.0, idle));
            solution.std[state] = [std, idle];
        }
    }
    solution
}

/// Φ(x), by the midpoint rule.
fn below(x: f64) -> f64 {
    let (steps, width) = (400, x / 400.0);
    let density = |t: f64| (-0.5 * t * t).exp() / std::f64::consts::TAU.sqrt();
    0.5 + (0..steps).map(|step| density((f64::from(step) + 0.5) * width) * width).sum::<f64>()
}

#[test]
fn every_action_value_and_deviation_of_a_chain_with_two_states_is_learned() {
    let _guard = GENERATOR.lock().unwrap();
    let experiment = chain();
    let mut random = Pcg64::seed_from_u64(5);
    let mut learner = learner(&experiment);
    for (steps, used) in [(1000, 0.0), (500, 1.0)] {
        // Smaller steps at the end, so that the estimate settles.
        learner.set_progress(used);
        for _ in 0..steps {
            learner.step(&play(&experiment, 32, &mut random).tensors()).unwrap();
        }
    }
    let networks = Networks::new(Device::Cpu, &spec(), &experiment);
    for ((name, parameter), (found, value)) in networks.entries("").into_iter().zip(learner.state()) {
        assert_eq!(name, found);
        tch::no_grad(|| parameter.shallow_clone().copy_(&value));
    }
    let mut sequences = play(&experiment, 256, &mut random);
    let minibatch = sequences.tensors();
    let noise = noise(1, 0, &minibatch, &experiment.svg0);
    let terms = losses(&networks, &networks, &minibatch, &noise, &experiment.svg0);
    let action_values: Vec<f64> = terms.action_value.to_kind(Kind::Double).try_into().unwrap();
    let deviations: Vec<Vec<f64>> = terms.std.to_kind(Kind::Double).try_into().unwrap();
    // Means over the rows of each state and action, and of each state.
    let (mut action_value, mut std) = ([[[0.0; 2]; 2]; 2], [[[0.0; 2]; 2]; 2]);
    let burn_in = experiment.svg0.burn_in;
    for (row, (found, deviation)) in action_values.iter().zip(&deviations).enumerate() {
        let (sequence, t) = (row / (ROWS - burn_in), row % (ROWS - burn_in) + burn_in);
        let state = usize::from(sequences.row(Field::Proprioception, sequence, t)[0] > 0.5);
        let goes = usize::from(sequences.row(Field::Action, sequence, t)[0] > 0.0);
        let add = |[sum, count]: &mut [f64; 2], value: f64| (*sum, *count) = (*sum + value, *count + 1.0);
        add(&mut action_value[state][goes], *found);
        (0..2).for_each(|entry| add(&mut std[state][entry], deviation[entry]));
    }
    let Solution { action_value: expected, std: expected_std } = solve(&experiment.svg0);
    for state in 0..2 {
        for index in 0..2 {
            let mean = |[sum, count]: [f64; 2]| sum / count;
            let (found, expected) = (mean(action_value[state][index]), expected[state][index]);
            assert!((found / expected - 1.0).abs() < 0.03, "Q({state}, {index}) is {found}, not {expected}");
            let (found, expected) = (mean(std[state][index]), expected_std[state][index]);
            assert!((found / expected - 1.0).abs() < 0.06, "σ_{index}({state}) is {found}, not {expected}");
        }
    }
}
