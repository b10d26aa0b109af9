//! Small tasks and generated unrolls for the tests of V-MPO.
#![allow(dead_code, reason = "each test uses its part")]

use std::sync::Arc;

use comic_experiment::{Experiment, LowLevelName, Lstm, Primitives, TaskPart, TaskSpec};
use comic_learner::algorithm::minibatch::MinibatchTensors;
use comic_learner::algorithm::shape::MinibatchShape;
use comic_learner::algorithm::{Algorithm, Parts};
use comic_learner::algorithms;
use comic_learner::vmpo::VmpoLearner;
use comic_learner::world::World;
use comic_networks::{Acting, Policy as _, RecurrentState, Routing};
use comic_proto::{Field, UnrollLayout, UnrollShape};
use tch::{Device, Kind, Tensor};

pub(crate) const UNROLLS: usize = 6;
pub(crate) const LENGTH: usize = 8;
/// Where the policy's mean starts.
const POSE: [f32; WIDTHS.action] = [0.1, -0.2, 0.3];
const WIDTHS: Widths = Widths { proprioception: 5, task: 4, action: 3, latent: 2, reward_terms: 2 };

struct Widths {
    proprioception: usize,
    task: usize,
    action: usize,
    latent: usize,
    reward_terms: usize,
}

pub(crate) fn spec() -> TaskSpec {
    TaskSpec {
        proprioception: WIDTHS.proprioception,
        task: WIDTHS.task,
        action: WIDTHS.action,
        reward_terms: vec!["near".into(), "far".into()],
        image: 0,
        clips: vec!["walk".into(), "run".into(), "jump".into()],
        tasks: vec![TaskPart { name: "tracking".into(), observation: WIDTHS.task, clips: 3, max_reward: 1.0 }],
    }
}

/// The same with a second task. Its clip is `lie`, and its observation is the last two entries.
pub(crate) fn joint_spec() -> TaskSpec {
    let mut spec = spec();
    spec.reward_terms = vec!["reward".into()];
    spec.clips.push("lie".into());
    spec.tasks.push(TaskPart { name: "get-up".into(), observation: 2, clips: 1, max_reward: 1.0 });
    spec
}

/// Small networks. ε of Adam is large, so that a step is nearly the gradient times a number: parameters that agree after
/// a step mean gradients that agree, which Adam's usual division by its own size would hide.
pub(crate) fn experiment() -> Experiment {
    let mut experiment = Experiment::default();
    experiment.network.encoder = vec![16, 16];
    experiment.network.mlp.hidden = vec![16, 16];
    experiment.network.value = vec![16, 16];
    experiment.network.latent.size = WIDTHS.latent;
    experiment.optimiser.epsilon = 10.0;
    experiment.optimiser.learning_rate = 1.0;
    experiment.optimiser.multiplier_learning_rate = 1.0;
    experiment
}

/// Small networks of every low level.
pub(crate) fn every_low_level() -> Vec<Experiment> {
    LowLevelName::ALL
        .map(|name| {
            let mut experiment = experiment();
            experiment.network.low_level = name;
            experiment.network.lstm = Lstm { units: vec![6, 5] };
            experiment.network.primitives =
                Primitives { count: 3, torso: vec![8], hidden: 6, gate: vec![7], biases: true };
            experiment
        })
        .to_vec()
}

/// The whole process shares libtorch's generator, so tests that seed it take turns.
pub(crate) static GENERATOR: std::sync::Mutex<()> = std::sync::Mutex::new(());

pub(crate) fn learner(experiment: &Experiment, seed: i64) -> VmpoLearner {
    learner_of(&spec(), experiment, seed)
}

pub(crate) fn learner_of(spec: &TaskSpec, experiment: &Experiment, seed: i64) -> VmpoLearner {
    seeded(seed, || VmpoLearner::new(spec, experiment, &POSE, Device::Cpu).unwrap())
}

/// The learner of the experiment's algorithm.
pub(crate) fn algorithm_on(device: Device, spec: &TaskSpec, experiment: &Experiment, seed: i64) -> Box<dyn Algorithm> {
    seeded(seed, || {
        algorithms::learner(Parts { experiment, spec, pose: &POSE, device, world: &World::alone() }).unwrap()
    })
}

fn seeded<L>(seed: i64, make: impl FnOnce() -> L) -> L {
    let _guard = GENERATOR.lock().unwrap();
    // Tests run in parallel, and the networks are too small for several threads.
    tch::set_num_threads(1);
    tch::manual_seed(seed);
    make()
}

/// Unrolls as they come over the wire; a test may change every field.
#[derive(Clone)]
pub(crate) struct Unrolls {
    pub(crate) count: usize,
    pub(crate) proprioception: Vec<f32>,
    pub(crate) task: Vec<f32>,
    pub(crate) previous_latent: Vec<f32>,
    pub(crate) latent_noise: Vec<f32>,
    pub(crate) action: Vec<f32>,
    pub(crate) mean: Vec<f32>,
    pub(crate) std: Vec<f32>,
    /// Empty if the experiment does not use it.
    pub(crate) action_gradient: Vec<f32>,
    pub(crate) reward: Vec<f32>,
    pub(crate) discount: Vec<f32>,
    pub(crate) valid: Vec<f32>,
    pub(crate) log_weights: Vec<f32>,
    pub(crate) first: Vec<f32>,
    pub(crate) state: Vec<f32>,
    pub(crate) clip: Vec<u32>,
    pub(crate) tasks: Vec<usize>,
    pub(crate) task_count: usize,
}

/// A reproducible stream of numbers in [−1, 1], so that no test depends on libtorch's generator.
pub(crate) struct Numbers(u64);

impl Numbers {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(2).wrapping_add(1))
    }

    pub(crate) fn next(&mut self) -> f32 {
        // Knuth's MMIX generator, of which the high bits are used.
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }

    pub(crate) fn take(&mut self, count: usize) -> Vec<f32> {
        (0..count).map(|_| self.next()).collect()
    }
}

impl Unrolls {
    /// `count` unrolls without an episode's end.
    pub(crate) fn random(seed: u64, count: usize) -> Self {
        let mut numbers = Numbers::new(seed);
        let (rows, observations) = (count * LENGTH, count * (LENGTH + 1));
        Self {
            count,
            proprioception: numbers.take(observations * WIDTHS.proprioception),
            task: numbers.take(observations * WIDTHS.task),
            previous_latent: numbers.take(rows * WIDTHS.latent),
            latent_noise: numbers.take(rows * WIDTHS.latent),
            action: numbers.take(rows * WIDTHS.action),
            mean: numbers.take(rows * WIDTHS.action),
            std: numbers.take(rows * WIDTHS.action).iter().map(|value| 0.6 + 0.3 * value).collect(),
            action_gradient: Vec::new(),
            reward: numbers.take(rows * WIDTHS.reward_terms),
            discount: vec![1.0; rows],
            valid: vec![1.0; rows],
            log_weights: Vec::new(),
            first: vec![0.0; observations],
            state: Vec::new(),
            clip: (0..observations).map(|row| (row / (LENGTH + 1) % 3) as u32).collect(),
            tasks: vec![0; count],
            task_count: 1,
        }
    }

    /// Generated unrolls of an experiment's sizes, of one task or of [`joint_spec`]'s two. `seed` decides the mix; every
    /// fourth seed gives one task alone. Some unrolls end an episode, by a fall or a clip's end, and some end in padding.
    pub(crate) fn recorded(experiment: &Experiment, spec: &TaskSpec, seed: u64, count: usize) -> Self {
        let mut unrolls = Self::random(seed, count);
        let mut numbers = Numbers::new(seed + 100);
        let UnrollShape { latent, components, state, .. } = UnrollShape::new(spec, experiment);
        let rows = count * LENGTH;
        unrolls.previous_latent = numbers.take(rows * latent);
        unrolls.latent_noise = numbers.take(rows * latent);
        unrolls.mean = numbers.take(rows * components * WIDTHS.action);
        unrolls.std = numbers.take(unrolls.mean.len()).iter().map(|value| 0.6 + 0.3 * value).collect();
        if components > 1 {
            unrolls.log_weights = vec![-(components as f32).ln(); rows * components];
        }
        unrolls.state = numbers.take(count * state);
        unrolls.reward = numbers.take(rows * spec.reward_terms.len());
        unrolls.task_count = spec.tasks.len();
        let alone = (seed % 4 == 3).then_some(seed as usize / 4 % spec.tasks.len());
        for unroll in 0..count {
            let task = (numbers.next().abs() * spec.tasks.len() as f32) as usize;
            unrolls.tasks[unroll] = alone.unwrap_or(task.min(spec.tasks.len() - 1));
            let row = 1 + (numbers.next().abs() * (LENGTH - 1) as f32) as usize;
            match (numbers.next() * 2.0) as i32 {
                1 => unrolls = unrolls.end_episode(unroll, row.min(LENGTH - 1), numbers.next() > 0.0),
                -1 => {
                    for padding in row..LENGTH {
                        unrolls.valid[unroll * LENGTH + padding] = 0.0;
                        unrolls.first[unroll * (LENGTH + 1) + padding + 1] = 1.0;
                    }
                }
                _ => {}
            }
            if unrolls.tasks[unroll] == 1 {
                let observations = unroll * (LENGTH + 1)..(unroll + 1) * (LENGTH + 1);
                unrolls.clip[observations.clone()].fill(3);
                for observation in observations {
                    // The second task's observation is the last two entries.
                    unrolls.task[observation * WIDTHS.task..][..WIDTHS.task - 2].fill(0.0);
                }
            }
        }
        unrolls
    }

    /// Ends the episode of `unroll` with the step into `row`, which then holds its last observation.
    pub(crate) fn end_episode(mut self, unroll: usize, row: usize, terminated: bool) -> Self {
        self.valid[unroll * LENGTH + row] = 0.0;
        self.discount[unroll * LENGTH + row - 1] = if terminated { 0.0 } else { 1.0 };
        self.first[unroll * (LENGTH + 1) + row + 1] = 1.0;
        self
    }

    pub(crate) fn shape(&self) -> MinibatchShape {
        let unroll = UnrollShape {
            length: LENGTH,
            proprioception: WIDTHS.proprioception,
            task: WIDTHS.task,
            action: WIDTHS.action,
            latent: self.latent_noise.len() / (self.count * LENGTH),
            reward_terms: self.reward.len() / (self.count * LENGTH),
            image: 0,
            components: self.mean.len() / self.action.len(),
            state: self.state.len() / self.count,
            action_gradient: self.action_gradient.len() / (self.count * LENGTH),
        };
        MinibatchShape { unrolls: self.count, tasks: self.task_count, unroll }
    }

    /// The same numbers as a batch has them.
    pub(crate) fn arrays(&self) -> comic_replay::Unrolls {
        let layout = UnrollLayout::new(self.shape().unroll);
        let mut arrays = comic_replay::Unrolls::new(Arc::new(layout), self.count);
        let floats = |field| match field {
            Field::Proprioception => &self.proprioception[..],
            Field::Task => &self.task,
            Field::PreviousLatent => &self.previous_latent,
            Field::LatentNoise => &self.latent_noise,
            Field::Action => &self.action,
            Field::Mean => &self.mean,
            Field::Std => &self.std,
            Field::LogWeights => &self.log_weights,
            Field::Reward => &self.reward,
            Field::Discount => &self.discount,
            Field::Valid => &self.valid,
            Field::First => &self.first,
            Field::State => &self.state,
            Field::ActionGradient => &self.action_gradient,
            Field::Clip | Field::Image => &[],
        };
        for field in Field::ALL {
            arrays.f32_mut(field).copy_from_slice(floats(field));
        }
        arrays.clip_mut().copy_from_slice(&self.clip);
        arrays
    }

    /// The `part`-th of `parts` equal parts, in the order of the unrolls.
    pub(crate) fn part(&self, part: usize, parts: usize) -> Self {
        fn cut<T: Clone>(values: &[T], part: usize, parts: usize) -> Vec<T> {
            let length = values.len() / parts;
            values[part * length..(part + 1) * length].to_vec()
        }
        let floats = |values: &Vec<f32>| cut(values, part, parts);
        Self {
            count: self.count / parts,
            proprioception: floats(&self.proprioception),
            task: floats(&self.task),
            previous_latent: floats(&self.previous_latent),
            latent_noise: floats(&self.latent_noise),
            action: floats(&self.action),
            mean: floats(&self.mean),
            std: floats(&self.std),
            action_gradient: floats(&self.action_gradient),
            reward: floats(&self.reward),
            discount: floats(&self.discount),
            valid: floats(&self.valid),
            log_weights: floats(&self.log_weights),
            first: floats(&self.first),
            state: floats(&self.state),
            clip: cut(&self.clip, part, parts),
            tasks: cut(&self.tasks, part, parts),
            task_count: self.task_count,
        }
    }

    pub(crate) fn minibatch(&self) -> MinibatchTensors {
        self.minibatch_on(Device::Cpu)
    }

    pub(crate) fn minibatch_on(&self, device: Device) -> MinibatchTensors {
        MinibatchTensors::new(&self.arrays(), &self.tasks, &self.shape(), device).unwrap()
    }

    /// Replaces actions and behaviour by what `learner`'s policy does in these observations, `rows` at a time.
    pub(crate) fn behave(&mut self, learner: &VmpoLearner, rows: usize) {
        let total = self.count * LENGTH;
        let unrolled = |values: &[f32], width: usize, length: usize| {
            let tensor = Tensor::from_slice(values).reshape([self.count as i64, length as i64, width as i64]);
            tensor.narrow(1, 0, LENGTH as i64).reshape([total as i64, width as i64])
        };
        let inputs = [
            unrolled(&self.proprioception, WIDTHS.proprioception, LENGTH + 1),
            unrolled(&self.task, WIDTHS.task, LENGTH + 1),
            unrolled(&self.previous_latent, WIDTHS.latent, LENGTH),
            unrolled(&self.latent_noise, WIDTHS.latent, LENGTH),
        ];
        let (mut means, mut stds) = (Vec::new(), Vec::new());
        for start in (0..total).step_by(rows) {
            let length = rows.min(total - start) as i64;
            let [s, x, z, noise] = inputs.each_ref().map(|input| input.narrow(0, start as i64, length));
            let acting = tch::no_grad(|| {
                let state = s.narrow(1, 0, 0);
                let observation = learner.policy().normalise(&s, &x, None, &Routing::single());
                learner.policy().act(&observation, &z, &noise, RecurrentState { state: &state, first: None })
            });
            means.extend(values(&acting.action.mean()));
            stds.extend(values(&acting.action.std()));
        }
        let noise = Numbers::new(77).take(means.len());
        self.action = means.iter().zip(&stds).zip(noise).map(|((mean, std), noise)| mean + std * 1.7 * noise).collect();
        (self.mean, self.std) = (means, stds);
    }
}

/// Fails when two tensors of the same rows are further apart than 1e-5 anywhere.
pub(crate) fn assert_close(what: &str, left: &Tensor, right: &Tensor) {
    let (left, right) = (left.reshape([-1]), right.reshape([-1]));
    assert_eq!(left.size(), right.size(), "{what}");
    if left.numel() > 0 {
        let apart = (left - right).abs().max().double_value(&[]);
        assert!(apart < 1e-5, "{what}: {apart} apart");
    }
}

impl Unrolls {
    /// What the learner's policy does on the whole unrolls at once, as learning takes it.
    pub(crate) fn act_at_once(&self, learner: &VmpoLearner, experiment: &Experiment, routing: &Routing) -> Acting {
        let count = self.count as i64;
        let steps = |values: &[f32], length: usize| {
            let width = values.len() / (self.count * length);
            Tensor::from_slice(values).reshape([count, length as i64, width as i64]).narrow(1, 0, LENGTH as i64)
        };
        let begins = steps(&self.first, LENGTH + 1).squeeze_dim(-1);
        assert!(begins.sum(Kind::Float).double_value(&[]) > 0.0, "an episode begins inside");
        let before = Tensor::from_slice(&self.state).reshape([count, experiment.network.state_size() as i64]);
        tch::no_grad(|| {
            let (proprioception, task) = (steps(&self.proprioception, LENGTH + 1), steps(&self.task, LENGTH + 1));
            let observation = learner.policy().normalise(&proprioception, &task, None, routing);
            let (previous, noise) = (steps(&self.previous_latent, LENGTH), steps(&self.latent_noise, LENGTH));
            let recurrent = RecurrentState { state: &before, first: Some(&begins) };
            learner.policy().act(&observation, &previous, &noise, recurrent)
        })
    }

    /// Fails unless the decisions in these unrolls, mean, deviation and weights, are these.
    pub(crate) fn assert_decided(&self, name: &str, acting: &Acting) {
        let (mean, std, log_weights) = acting.action.to_rows();
        assert_close(&format!("{name}: mean"), &mean, &Tensor::from_slice(&self.mean));
        assert_close(&format!("{name}: std"), &std, &Tensor::from_slice(&self.std));
        assert_eq!(log_weights.is_some(), !self.log_weights.is_empty(), "{name}");
        if let Some(log_weights) = log_weights {
            assert_close(&format!("{name}: weights"), &log_weights, &Tensor::from_slice(&self.log_weights));
        }
    }
}

pub(crate) fn values(tensor: &Tensor) -> Vec<f32> {
    Vec::try_from(tensor.contiguous().view(-1)).unwrap()
}

/// The learner's state as numbers, by name.
pub(crate) fn state(learner: &dyn Algorithm) -> Vec<(String, Vec<f64>)> {
    learner
        .state()
        .into_iter()
        .map(|(name, tensor)| (name, Vec::try_from(tensor.to_kind(tch::Kind::Double).contiguous().view(-1)).unwrap()))
        .collect()
}

/// The largest difference between two states, relative to the largest number of the same tensor (at least 1e-3).
pub(crate) fn difference(left: &VmpoLearner, right: &VmpoLearner) -> f64 {
    let mut worst = 0f64;
    for ((name, left), (_, right)) in state(left).into_iter().zip(state(right)) {
        let scale = left.iter().fold(1e-3, |scale: f64, value| scale.max(value.abs()));
        for (left, right) in left.iter().zip(&right) {
            assert!(left.is_finite() && right.is_finite(), "{name}");
            worst = worst.max((left - right).abs() / scale);
        }
    }
    worst
}
