//! A small task for SVG(0), and generated sequences.
#![allow(dead_code, reason = "each test uses its part")]

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

pub(crate) const SEQUENCES: usize = 4;
pub(crate) const LENGTH: usize = 6;
pub(crate) const ACTION: usize = 2;

/// The whole process shares libtorch's generator, and every gradient step seeds it.
pub(crate) static GENERATOR: std::sync::Mutex<()> = std::sync::Mutex::new(());

pub(crate) fn spec() -> TaskSpec {
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

pub(crate) fn experiment() -> Experiment {
    let mut experiment = Experiment { algorithm: AlgorithmName::Svg0, ..Experiment::default() };
    experiment.unroll.length = LENGTH;
    let svg0 = &mut experiment.svg0;
    (svg0.encoder, svg0.action_value) = (vec![8], vec![16]);
    (svg0.core, svg0.policy, svg0.burn_in, svg0.action_samples) = (6, 5, 2, 4);
    // Nearly the gradient times a number, so that equal parameters after a step mean equal gradients.
    (experiment.optimiser.epsilon, experiment.optimiser.learning_rate) = (10.0, 1.0);
    experiment
}

pub(crate) fn learner(experiment: &Experiment) -> Svg0Learner {
    tch::set_num_threads(1);
    tch::manual_seed(3);
    Svg0Learner::new(&spec(), experiment, Device::Cpu).unwrap()
}

/// Sequences as they come over the wire.
#[derive(Clone)]
pub(crate) struct Sequences {
    pub(crate) unrolls: Unrolls,
    pub(crate) shape: MinibatchShape,
}

impl Sequences {
    pub(crate) fn new(experiment: &Experiment, count: usize, seed: u64) -> Self {
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

    pub(crate) fn tensors(&self) -> MinibatchTensors {
        let tasks = vec![0; self.shape.unrolls];
        MinibatchTensors::new(&self.unrolls, &tasks, &self.shape, Device::Cpu).unwrap()
    }

    /// The numbers of one row of a sequence.
    pub(crate) fn row(&mut self, field: Field, sequence: usize, t: usize) -> &mut [f32] {
        let (rows, width) = (field.rows(self.shape.unroll.length), field.width(&self.shape.unroll));
        let start = (sequence * rows + t) * width;
        &mut self.unrolls.f32_mut(field)[start..start + width]
    }

    /// Row `t` holds an episode's last observation.
    pub(crate) fn end_episode(mut self, sequence: usize, t: usize, terminated: bool) -> Self {
        self.row(Field::Valid, sequence, t)[0] = 0.0;
        self.row(Field::Discount, sequence, t - 1)[0] = if terminated { 0.0 } else { 1.0 };
        self.row(Field::First, sequence, t + 1)[0] = 1.0;
        self
    }
}

/// The state after one gradient step.
pub(crate) fn after_step(experiment: &Experiment, sequences: &Sequences) -> HashMap<String, Tensor> {
    let mut learner = learner(experiment);
    let losses = learner.step(&sequences.tensors()).unwrap().to_values();
    assert!(losses.is_finite() && losses.skipped == 0, "{losses:?}");
    learner.state().into_iter().collect()
}

pub(crate) fn largest_difference(one: &HashMap<String, Tensor>, other: &HashMap<String, Tensor>, part: &str) -> f64 {
    let of = |name: &String| (&one[name] - &other[name]).abs().max().double_value(&[]);
    one.keys().filter(|name| name.starts_with(part)).map(of).fold(0.0, f64::max)
}
