//! The floor of an update.

use anyhow::Result;
use comic_experiment::{Experiment, TaskSpec};
use comic_learner::device::Backend;
use comic_networks::{Layer, Sizes, low_level_layers};
use tch::{Device, Kind, Tensor};

/// The matrix products of one linear layer.
struct Product {
    /// `[rows, inputs]`.
    input: Tensor,
    /// `[outputs, inputs]`.
    weight: Tensor,
    /// Of the output, `[rows, outputs]`.
    gradient: Tensor,
    /// Whether the gradient flows to the input.
    flows_on: bool,
}

impl Product {
    fn new(rows: i64, inputs: i64, outputs: i64, flows_on: bool, device: Device) -> Self {
        let random = |size: [i64; 2]| Tensor::randn(size, (Kind::Float, device));
        let (input, weight, gradient) = (random([rows, inputs]), random([outputs, inputs]), random([rows, outputs]));
        Self { input, weight, gradient, flows_on }
    }

    /// The results must live until the end of the step: XLA removes what has no use.
    fn run(&self) -> Vec<Tensor> {
        let mut made = vec![self.input.matmul(&self.weight.tr()), self.gradient.tr().matmul(&self.input)];
        if self.flows_on {
            made.push(self.gradient.matmul(&self.weight));
        }
        made
    }
}

/// libtorch's own LSTM with the shapes of ours, forward and backward.
struct FusedLstm {
    /// `[T, B, inputs]`.
    input: Tensor,
    /// `[1, B, units]`, h and c.
    state: [Tensor; 2],
    /// For the input, for the state, and two biases.
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

/// The least that an update can cost: its matrix products, and the LSTM layers of libtorch.
pub(super) struct Floor {
    device: Device,
    products: Vec<Product>,
    lstms: Vec<FusedLstm>,
}

impl Floor {
    /// The layers of the experiment's policy and value networks.
    pub(super) fn new(spec: &TaskSpec, experiment: &Experiment, device: Device) -> Self {
        let network = &experiment.network;
        let (unrolls, length) = (experiment.unroll.batch as i64, experiment.unroll.length as i64);
        let (steps, observations) = (unrolls * length, unrolls * (length + 1));
        let (latent, sensed) = (network.latent.size as i64, (spec.task + spec.proprioception) as i64);
        let mut floor = Self { device, products: Vec::new(), lstms: Vec::new() };
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

    /// Hidden layers and an output layer over `rows`. `flows_on` says whether a layer below them is learned.
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

    /// Stacked LSTM layers over `rows` of `unrolls`. Returns the width of the last one.
    fn lstm(&mut self, rows: i64, unrolls: i64, input: i64, units: &[usize]) -> i64 {
        units.iter().fold(input, |width, units| {
            self.lstms.push(FusedLstm::new(rows / unrolls, unrolls, width, *units as i64, self.device));
            *units as i64
        })
    }

    /// One layer over `rows` of `unrolls`.
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

    /// Computes all of them once.
    pub(super) fn run(&self, backend: &Backend) -> Result<()> {
        let products = self.products.iter().flat_map(Product::run);
        let made: Vec<Tensor> = products.chain(self.lstms.iter().flat_map(FusedLstm::run)).collect();
        backend.end_step()?;
        drop(made);
        Ok(backend.wait()?)
    }
}
