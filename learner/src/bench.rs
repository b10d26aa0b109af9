//! `comic-learner bench`: the update against its bare matrix products.

use std::time::Instant;

use anyhow::{Context as _, Result};
use comic_experiment::{DeviceName, Experiment, Learner, LowLevelName, TaskSpec};
use comic_networks::{Layer, Sizes, low_level_layers, to_safetensors};
use comic_proto::{Field, PerField, UnrollLayout, UnrollShape};
use serde_json::json;
use tch::{Device, Kind, Tensor};

use crate::algorithm::Algorithm as _;
use crate::algorithm::minibatch::{MinibatchSource, MinibatchTensors};
use crate::algorithm::shape::MinibatchShape;
use crate::device::Backend;
use crate::vmpo::VmpoLearner;

/// One linear layer's products: rows × inputs → outputs, and whether the gradient flows on to its input.
struct Product {
    input: Tensor,
    weight: Tensor,
    gradient: Tensor,
    flows_on: bool,
}

impl Product {
    fn new(rows: i64, inputs: i64, outputs: i64, flows_on: bool, device: Device) -> Self {
        let random = |size: [i64; 2]| Tensor::randn(size, (Kind::Float, device));
        let (input, weight, gradient) = (random([rows, inputs]), random([outputs, inputs]), random([rows, outputs]));
        Self { input, weight, gradient, flows_on }
    }

    /// What is made has to be kept until the step's end, or XLA would see that nobody wants it.
    fn run(&self) -> Vec<Tensor> {
        let mut made = vec![self.input.matmul(&self.weight.tr()), self.gradient.tr().matmul(&self.input)];
        if self.flows_on {
            made.push(self.gradient.matmul(&self.weight));
        }
        made
    }
}

/// libtorch's own LSTM on the shapes of ours, forward and backward.
struct FusedLstm {
    /// `[T, B, inputs]`.
    input: Tensor,
    /// `[1, B, units]`, h and c.
    state: [Tensor; 2],
    /// Of the input, of the state, and both biases.
    weights: Vec<Tensor>,
}

impl FusedLstm {
    fn new(steps: i64, unrolls: i64, inputs: i64, units: i64, device: Device) -> Self {
        let random = |size: &[i64]| Tensor::randn(size, (Kind::Float, device));
        let weights = [vec![4 * units, inputs], vec![4 * units, units], vec![4 * units], vec![4 * units]];
        Self {
            input: random(&[steps, unrolls, inputs]).set_requires_grad(true),
            state: [(); 2].map(|()| random(&[1, unrolls, units])),
            weights: weights.iter().map(|size| (random(size) * 0.05).set_requires_grad(true)).collect(),
        }
    }

    fn run(&self) -> Vec<Tensor> {
        let (output, ..) = self.input.lstm(&self.state, &self.weights, true, 1, 0.0, true, false, false);
        let inputs: Vec<&Tensor> = self.weights.iter().chain([&self.input]).collect();
        Tensor::run_backward(&[output.sum(Kind::Float)], &inputs, false, false)
    }
}

/// The least an update can cost: its products, and the LSTM layers of a library.
struct Floor {
    device: Device,
    products: Vec<Product>,
    lstms: Vec<FusedLstm>,
}

impl Floor {
    /// Hidden layers and an output over `rows`; `flows_on` says whether anything below them is learnt.
    fn layers(&mut self, rows: i64, input: i64, hidden: &[usize], output: i64, flows_on: bool) {
        let mut width = input;
        for (index, size) in hidden.iter().enumerate() {
            self.products.push(Product::new(rows, width, *size as i64, flows_on || index > 0, self.device));
            width = *size as i64;
        }
        if output > 0 {
            self.products.push(Product::new(rows, width, output, flows_on || !hidden.is_empty(), self.device));
        }
    }

    /// Stacked LSTM layers over `rows` of `unrolls`; gives the width of the last.
    fn lstm(&mut self, rows: i64, unrolls: i64, input: i64, units: &[usize]) -> i64 {
        units.iter().fold(input, |width, units| {
            self.lstms.push(FusedLstm::new(rows / unrolls, unrolls, width, *units as i64, self.device));
            *units as i64
        })
    }

    /// A layer over `rows` of `unrolls`.
    fn layer(&mut self, rows: i64, unrolls: i64, layer: Layer) {
        match layer {
            Layer::Dense { input, output, flows_on } => {
                self.products.push(Product::new(rows, input as i64, output as i64, flows_on, self.device));
            }
            Layer::Lstm { input, units } => {
                self.lstm(rows, unrolls, input as i64, &[units]);
            }
        }
    }

    fn run(&self, backend: &Backend) -> Result<()> {
        let products = self.products.iter().flat_map(Product::run);
        let made: Vec<Tensor> = products.chain(self.lstms.iter().flat_map(FusedLstm::run)).collect();
        backend.end_step()?;
        drop(made);
        backend.wait()
    }
}

/// Prints `learner.update` as one JSON line: milliseconds for a gradient step of paper size (128 unrolls of 32) with its
/// batch on the device, and those for bringing the batch there and the parameters back; floor
/// the matrix products of the same shapes, forward and backward, on the same threads, and libtorch's own LSTM where there
/// is one; medians of interleaved runs. Another low level than the MLP is the preset's of its name, and joint training is
/// `joint-get-up`'s; the figure's name says it. Joint training stands beside the update of its first task alone, in the
/// same run.
///
/// # Errors
/// When libtorch refuses.
pub fn run(threads: usize, repeats: usize, subject: Subject, device: DeviceName) -> Result<()> {
    tch::set_num_threads(threads as i32);
    tch::manual_seed(1);
    let (preset, figure) = match subject {
        Subject::LowLevel(LowLevelName::Mlp) => ("tracking-mlp".to_string(), "learner.update".to_string()),
        Subject::LowLevel(other) => (format!("tracking-{other}"), format!("learner.update.{other}")),
        Subject::Joint => ("joint-get-up".to_string(), "learner.update.joint".to_string()),
    };
    let experiment = comic_experiment::resolve(&preset, &[])?;
    let backend = Backend::open(&Learner { device, ..experiment.learner.clone() })?;
    let mut update = Update::new(&experiment, &backend)?;
    let alone = Experiment { joint: Vec::new(), ..experiment.clone() };
    let mut one_task = matches!(subject, Subject::Joint).then(|| Update::new(&alone, &backend)).transpose()?;
    let least = floor(&update.spec, &experiment, backend.device());
    let (mut updates, mut one_tasks, mut floors) = (Vec::new(), Vec::new(), Vec::new());
    let (mut copies, mut reads) = (Vec::new(), Vec::new());
    for repeat in 0..repeats + 2 {
        let copy = milliseconds(|| update.refill(&backend))?;
        let value = update.run(&backend)?;
        let read = milliseconds(|| to_safetensors(update.learner.policy_store()))?;
        let one_task = one_task.as_mut().map(|update| update.run(&backend)).transpose()?;
        let floor = milliseconds(|| least.run(&backend))?;
        // The first two warm up.
        if repeat >= 2 {
            updates.push(value);
            copies.push(copy);
            reads.push(read);
            one_tasks.extend(one_task);
            floors.push(floor);
        }
    }
    let (value, floor) = (median(updates), median(floors));
    let mut line = json!({
        "figure": figure, "value": value, "unit": "ms", "floor": floor, "ratio": value / floor,
        "threads": threads, "repeats": repeats, "device": device.to_string(), "copy": median(copies),
        "read_back": median(reads), "compilations": backend.compilations()?,
    });
    if !one_tasks.is_empty() {
        let one_task = median(one_tasks);
        line["one_task"] = json!(one_task);
        line["against_one_task"] = json!(value / one_task);
    }
    println!("{line}");
    Ok(())
}

/// What is updated.
#[derive(Clone, Copy, Debug)]
pub enum Subject {
    /// The paper's tracking with this low level.
    LowLevel(LowLevelName),
    /// Two tasks together.
    Joint,
}

/// Networks of paper size and a batch for them.
struct Update {
    spec: TaskSpec,
    learner: VmpoLearner,
    recorded: Recorded,
    minibatch: MinibatchTensors,
}

impl Update {
    fn new(experiment: &Experiment, backend: &Backend) -> Result<Self> {
        let spec = TaskSpec::new(experiment, vec!["clip".into()])
            .map_err(|name| anyhow::anyhow!("no observation `{name}`"))?;
        let learner = VmpoLearner::new(&spec, experiment, &vec![0.0; spec.action], backend.device())?;
        let recorded = Recorded::new(&spec, experiment)?;
        let minibatch = recorded.to_tensors(backend.device())?;
        Ok(Self { spec, learner, recorded, minibatch })
    }

    /// Brings the batch to the device once more.
    fn refill(&mut self, backend: &Backend) -> Result<()> {
        self.minibatch = self.recorded.to_tensors(backend.device())?;
        backend.end_step()?;
        backend.wait()
    }

    /// Milliseconds of a gradient step.
    fn run(&mut self, backend: &Backend) -> Result<f64> {
        let Self { learner, minibatch, .. } = self;
        milliseconds(|| {
            let losses = learner.step(minibatch)?;
            backend.end_step()?;
            Ok::<_, anyhow::Error>(losses.to_values())
        })
    }
}

fn floor(spec: &TaskSpec, experiment: &Experiment, device: Device) -> Floor {
    let network = &experiment.network;
    let (unrolls, length) = (experiment.unroll.batch as i64, experiment.unroll.length as i64);
    let (steps, observations) = (unrolls * length, unrolls * (length + 1));
    let (latent, sensed) = (network.latent.size as i64, (spec.task + spec.proprioception) as i64);
    let mut floor = Floor { device, products: Vec::new(), lstms: Vec::new() };
    let encoded = if latent > 0 { 2 * latent } else { network.primitives.count as i64 };
    floor.layers(steps, sensed + latent, &network.encoder, encoded, false);
    if network.encoder_linear_path && latent > 0 {
        floor.layers(steps, sensed + latent, &[], 2 * latent, false);
    }
    let sizes = Sizes { proprioception: spec.proprioception, actions: spec.action, network };
    for layer in low_level_layers(&sizes) {
        floor.layer(steps, unrolls, layer);
    }
    let input = sensed + network.clip_embedding as i64;
    let terms = spec.reward_terms.len() as i64;
    if network.value_lstm.is_empty() {
        floor.layers(observations, input, &network.value, terms, true);
    } else {
        floor.layers(observations, input, &network.value, 0, true);
        let hidden = network.value.last().map_or(input, |size| *size as i64);
        let units = floor.lstm(observations, unrolls, hidden, &network.value_lstm);
        floor.layers(observations, units, &[], terms, true);
    }
    floor
}

/// A batch of generated unrolls, as it lies in memory after it came over the wire.
struct Recorded {
    shape: MinibatchShape,
    floats: PerField<Vec<f32>>,
    clips: Vec<u32>,
    tasks: Vec<usize>,
}

impl Recorded {
    fn new(spec: &TaskSpec, experiment: &Experiment) -> Result<Self> {
        let layout = UnrollLayout::new(UnrollShape::new(spec, experiment));
        let (unroll, unrolls) = (*layout.shape(), experiment.unroll.batch);
        let mut floats = PerField::from_fn(|_| Vec::new());
        for (field, values) in floats.iter_mut() {
            let count = layout.elements(field) * unrolls;
            *values = match field {
                Field::Discount | Field::Valid => vec![1.0; count],
                Field::Std => vec![0.7; count],
                Field::LogWeights => vec![-(unroll.components as f32).ln(); count],
                Field::First | Field::State => vec![0.0; count],
                Field::Clip | Field::Image => Vec::new(),
                _ => Vec::try_from(Tensor::randn([count as i64], (Kind::Float, Device::Cpu)))
                    .context("random numbers")?,
            };
        }
        // Unrolls of all tasks in turn; in the bench every task has one clip.
        let tasks: Vec<usize> = (0..unrolls).map(|index| index % spec.tasks.len()).collect();
        Ok(Self {
            floats,
            clips: tasks.iter().flat_map(|task| vec![*task as u32; layout.rows(Field::Clip)]).collect(),
            tasks,
            shape: MinibatchShape { unrolls, tasks: spec.tasks.len(), unroll },
        })
    }

    fn to_tensors(&self, device: Device) -> Result<MinibatchTensors> {
        let source = MinibatchSource {
            floats: self.floats.each_ref().map(|_, values| values.as_slice()),
            clip: &self.clips,
            image: &[],
            tasks: &self.tasks,
        };
        Ok(MinibatchTensors::new(&source, &self.shape, device)?)
    }
}

fn milliseconds<T, E: Into<anyhow::Error>>(work: impl FnOnce() -> Result<T, E>) -> Result<f64> {
    let start = Instant::now();
    work().map_err(Into::into)?;
    Ok(start.elapsed().as_secs_f64() * 1e3)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}
