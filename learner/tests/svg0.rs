//! SVG(0): its laws, and a task whose action value is known.
#![allow(clippy::unwrap_used, reason = "helpers of tests may panic")]

use std::collections::HashMap;
use std::sync::Arc;

use comic_experiment::{AlgorithmName, Experiment, TaskPart, TaskSpec};
use comic_learner::algorithm::Algorithm as _;
use comic_learner::algorithm::minibatch::MinibatchTensors;
use comic_learner::algorithm::shape::MinibatchShape;
use comic_learner::svg0::Svg0Learner;
use comic_proto::{Field, UnrollLayout, UnrollShape};
use comic_replay::Unrolls;
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;
use tch::{Device, Tensor};

const SEQUENCES: usize = 4;
const LENGTH: usize = 6;
const ACTION: usize = 2;

/// The whole process shares libtorch's generator, and every gradient step seeds it.
static GENERATOR: std::sync::Mutex<()> = std::sync::Mutex::new(());

fn spec() -> TaskSpec {
    let task = TaskPart { name: "go-to-target".into(), observation: 2, clips: 1, max_reward: 1.0 };
    TaskSpec {
        proprioception: 3,
        task: 2,
        action: ACTION,
        reward_terms: vec!["target".into()],
        clips: vec!["go-to-target".into()],
        tasks: vec![task],
        ..TaskSpec::default()
    }
}

fn experiment() -> Experiment {
    let mut experiment = Experiment::default();
    experiment.algorithm = AlgorithmName::Svg0;
    experiment.unroll.length = LENGTH;
    let svg0 = &mut experiment.svg0;
    (svg0.encoder, svg0.action_value) = (vec![8], vec![16]);
    (svg0.core, svg0.policy, svg0.burn_in, svg0.action_samples) = (6, 5, 2, 4);
    // Nearly the gradient times a number, so that equal parameters after a step mean equal gradients.
    (experiment.optimiser.epsilon, experiment.optimiser.learning_rate) = (10.0, 1.0);
    experiment
}

fn learner(experiment: &Experiment) -> Svg0Learner {
    tch::set_num_threads(1);
    tch::manual_seed(3);
    Svg0Learner::new(&spec(), experiment, Device::Cpu).unwrap()
}

/// Sequences as they come over the wire.
#[derive(Clone)]
struct Sequences {
    unrolls: Unrolls,
    shape: MinibatchShape,
}

impl Sequences {
    fn new(experiment: &Experiment, count: usize, seed: u64) -> Self {
        let unroll = UnrollShape::new(&spec(), experiment);
        let mut random = Pcg64::seed_from_u64(seed);
        let mut unrolls = Unrolls::new(Arc::new(UnrollLayout::new(unroll)), count);
        for field in Field::ALL {
            unrolls.f32_mut(field).fill_with(|| match field {
                Field::Std => random.random_range(0.5..1.0),
                Field::Discount | Field::Valid => 1.0,
                Field::First => 0.0,
                Field::State => random.random_range(-0.2..0.2),
                _ => random.random_range(-1.0_f32..1.0),
            });
        }
        Self { unrolls, shape: MinibatchShape { unrolls: count, tasks: 1, unroll } }
    }

    fn tensors(&self) -> MinibatchTensors {
        let tasks = vec![0; self.shape.unrolls];
        MinibatchTensors::new(&self.unrolls, &tasks, &self.shape, Device::Cpu).unwrap()
    }

    /// The numbers of one row of a sequence.
    fn row(&mut self, field: Field, sequence: usize, t: usize) -> &mut [f32] {
        let (rows, width) = (field.rows(self.shape.unroll.length), field.width(&self.shape.unroll));
        let start = (sequence * rows + t) * width;
        &mut self.unrolls.f32_mut(field)[start..start + width]
    }

    /// Row `t` holds an episode's last observation.
    fn end_episode(mut self, sequence: usize, t: usize, terminated: bool) -> Self {
        self.row(Field::Valid, sequence, t)[0] = 0.0;
        self.row(Field::Discount, sequence, t - 1)[0] = if terminated { 0.0 } else { 1.0 };
        self.row(Field::First, sequence, t + 1)[0] = 1.0;
        self
    }
}

/// The state after one gradient step.
fn after_step(experiment: &Experiment, sequences: &Sequences) -> HashMap<String, Tensor> {
    let mut learner = learner(experiment);
    let losses = learner.step(&sequences.tensors()).unwrap().to_values();
    assert!(losses.is_finite() && losses.skipped == 0, "{losses:?}");
    learner.state().into_iter().collect()
}

fn largest_difference(one: &HashMap<String, Tensor>, other: &HashMap<String, Tensor>, part: &str) -> f64 {
    let of = |name: &String| (&one[name] - &other[name]).abs().max().double_value(&[]);
    one.keys().filter(|name| name.starts_with(part)).map(of).fold(0.0, f64::max)
}

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
    (experiment.optimiser.epsilon, experiment.optimiser.learning_rate) = (1e-8, 3e-3);
    experiment.optimiser.final_learning_rate_share = 1.0 / 15.0;
    experiment.network.min_std = 0.3;
    experiment.network.initial_std = 0.7;
    let svg0 = &mut experiment.svg0;
    (svg0.target_period, svg0.discount) = (25, 0.8);
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
            learner.set_progress(1.0);
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
