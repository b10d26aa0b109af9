//! `comic-learner bench`: the update against its bare matrix products.

use std::time::Instant;

use anyhow::{Context as _, Result};
use comic_experiment::{Experiment, TaskSpec};
use comic_proto::UnrollShape;
use serde_json::json;
use tch::{Device, Kind, Tensor};

use crate::vmpo::{MinibatchShape, MinibatchSource, MinibatchTensors, VmpoLearner};

/// One linear layer's products: rows × inputs → outputs, and whether the gradient flows on to its input.
struct Product {
    input: Tensor,
    weight: Tensor,
    gradient: Tensor,
    flows_on: bool,
}

impl Product {
    fn new(rows: i64, inputs: i64, outputs: i64, flows_on: bool) -> Self {
        let random = |size: [i64; 2]| Tensor::randn(size, (Kind::Float, Device::Cpu));
        let (input, weight, gradient) = (random([rows, inputs]), random([outputs, inputs]), random([rows, outputs]));
        Self { input, weight, gradient, flows_on }
    }

    fn run(&self) {
        let _ = self.input.matmul(&self.weight.tr());
        let _ = self.gradient.tr().matmul(&self.input);
        if self.flows_on {
            let _ = self.gradient.matmul(&self.weight);
        }
    }
}

/// Prints `learner.update` as one JSON line: milliseconds for a gradient step of paper size (128 unrolls of 32), floor
/// the matrix products of the same shapes, forward and backward, on the same threads; medians of interleaved runs.
///
/// # Errors
/// When libtorch refuses.
pub fn run(threads: usize, repeats: usize) -> Result<()> {
    tch::set_num_threads(threads as i32);
    tch::manual_seed(1);
    let experiment = Experiment::default();
    let spec =
        TaskSpec::new(&experiment, vec!["clip".into()]).map_err(|name| anyhow::anyhow!("no observation `{name}`"))?;
    let mut learner = VmpoLearner::new(&spec, &experiment, &vec![0.0; spec.action], Device::Cpu)?;
    let minibatch = random_minibatch(&spec, &experiment)?;
    let products = products(&spec, &experiment);
    let (mut updates, mut floors) = (Vec::new(), Vec::new());
    for repeat in 0..repeats + 2 {
        let update = milliseconds(|| learner.step(&minibatch).map(|losses| losses.to_metrics()))?;
        let floor = milliseconds(|| -> Result<(), crate::vmpo::Error> {
            products.iter().for_each(Product::run);
            Ok(())
        })?;
        // The first two warm up.
        if repeat >= 2 {
            updates.push(update);
            floors.push(floor);
        }
    }
    let (value, floor) = (median(updates), median(floors));
    let line = json!({
        "figure": "learner.update", "value": value, "unit": "ms", "floor": floor, "ratio": value / floor,
        "threads": threads, "repeats": repeats,
    });
    println!("{line}");
    Ok(())
}

fn products(spec: &TaskSpec, experiment: &Experiment) -> Vec<Product> {
    let network = &experiment.network;
    let steps = (experiment.unroll.batch * experiment.unroll.length) as i64;
    let observations = steps + experiment.unroll.batch as i64;
    let latent = network.latent.size as i64;
    let sensed = (spec.task + spec.proprioception) as i64;
    let mut products = Vec::new();
    let mut layers = |rows: i64, input: i64, hidden: &[usize], output: i64, flows_on: bool| {
        let mut width = input;
        for (index, size) in hidden.iter().enumerate() {
            products.push(Product::new(rows, width, *size as i64, flows_on || index > 0));
            width = *size as i64;
        }
        products.push(Product::new(rows, width, output, true));
    };
    layers(steps, sensed + latent, &network.encoder, 2 * latent, false);
    layers(steps, latent + spec.proprioception as i64, &network.mlp.hidden, 2 * spec.action as i64, true);
    let embedding = network.clip_embedding as i64;
    layers(observations, sensed + embedding, &network.value, spec.reward_terms.len() as i64, true);
    if network.encoder_linear_path {
        products.push(Product::new(steps, sensed + latent, 2 * latent, false));
    }
    products
}

fn random_minibatch(spec: &TaskSpec, experiment: &Experiment) -> Result<MinibatchTensors> {
    let shape = UnrollShape::new(spec, experiment);
    let unrolls = experiment.unroll.batch;
    let (rows, observations) = (unrolls * shape.length, unrolls * (shape.length + 1));
    let (components, weights) = (shape.components, if shape.components > 1 { shape.components } else { 0 });
    let random = |count: usize| {
        Vec::<f32>::try_from(Tensor::randn([count as i64], (Kind::Float, Device::Cpu))).context("random numbers")
    };
    let source = MinibatchSource {
        proprioception: &random(observations * shape.proprioception)?,
        task: &random(observations * shape.task)?,
        previous_latent: &random(rows * shape.latent)?,
        latent_noise: &random(rows * shape.latent)?,
        action: &random(rows * shape.action)?,
        mean: &random(rows * components * shape.action)?,
        std: &vec![0.7; rows * components * shape.action],
        log_weights: &vec![-(components as f32).ln(); rows * weights],
        reward: &random(rows * shape.reward_terms)?,
        discount: &vec![1.0; rows],
        valid: &vec![1.0; rows],
        first: &vec![0.0; observations],
        state: &vec![0.0; unrolls * shape.state],
        clip: &vec![0; observations],
        image: &[],
    };
    let shape = MinibatchShape { unrolls, unroll: shape };
    Ok(MinibatchTensors::new(&source, &shape, Device::Cpu)?)
}

fn milliseconds<T, E>(work: impl FnOnce() -> Result<T, E>) -> Result<f64, E> {
    let start = Instant::now();
    work()?;
    Ok(start.elapsed().as_secs_f64() * 1e3)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}
