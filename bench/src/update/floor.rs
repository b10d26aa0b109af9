//! The floor of an update.

use anyhow::Result;
use comic_learner::device::Backend;
use comic_networks::Layer;
use tch::{Device, Kind, Tensor};

/// Which gradients are computed: those of the weights, and those of the input.
#[derive(Clone, Copy)]
pub(super) struct Gradients {
    pub(super) weights: bool,
    pub(super) input: bool,
}

impl Gradients {
    pub(super) const NONE: Self = Self { weights: false, input: false };
    pub(super) const WEIGHTS: Self = Self { weights: true, input: false };
    pub(super) const INPUT: Self = Self { weights: false, input: true };
    pub(super) const BOTH: Self = Self { weights: true, input: true };
}

/// The matrix products of one linear layer.
struct Product {
    /// `[rows, inputs]`.
    input: Tensor,
    /// `[outputs, inputs]`.
    weight: Tensor,
    /// Of the output, `[rows, outputs]`.
    gradient: Tensor,
    wanted: Gradients,
}

impl Product {
    fn new([rows, inputs, outputs]: [i64; 3], wanted: Gradients, device: Device) -> Self {
        let random = |size: [i64; 2]| Tensor::randn(size, (Kind::Float, device));
        let (input, weight, gradient) = (random([rows, inputs]), random([outputs, inputs]), random([rows, outputs]));
        Self { input, weight, gradient, wanted }
    }

    /// The results must live until the end of the step: XLA removes what has no use.
    fn run(&self) -> Vec<Tensor> {
        let mut made = vec![self.input.matmul(&self.weight.tr())];
        if self.wanted.weights {
            made.push(self.gradient.tr().matmul(&self.input));
        }
        if self.wanted.input {
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
    fn new([steps, unrolls, inputs, units]: [i64; 4], wanted: Gradients, device: Device) -> Self {
        let random = |size: &[i64]| Tensor::randn(size, (Kind::Float, device));
        let weights = [vec![4 * units, inputs], vec![4 * units, units], vec![4 * units], vec![4 * units]];
        Self {
            input: random(&[steps, unrolls, inputs]).set_requires_grad(wanted.input),
            state: [(); 2].map(|()| random(&[1, unrolls, units])),
            weights: weights.iter().map(|size| (random(size) * 0.05).set_requires_grad(wanted.weights)).collect(),
        }
    }

    fn run(&self) -> Vec<Tensor> {
        let (output, ..) = self.input.lstm(&self.state, &self.weights, true, 1, 0.0, true, false, false);
        let wanted: Vec<&Tensor> = self.weights.iter().chain([&self.input]).filter(|of| of.requires_grad()).collect();
        if wanted.is_empty() {
            return vec![output];
        }
        Tensor::run_backward(&[output.sum(Kind::Float)], &wanted, false, false)
    }
}

/// The least that an update can cost: its matrix products, and the LSTM layers of libtorch.
pub(super) struct Floor {
    device: Device,
    /// Unrolls of the update.
    unrolls: i64,
    products: Vec<Product>,
    lstms: Vec<FusedLstm>,
}

impl Floor {
    /// Of an update with so many unrolls, still without a layer.
    pub(super) fn new(unrolls: usize, device: Device) -> Self {
        Self { device, unrolls: unrolls as i64, products: Vec::new(), lstms: Vec::new() }
    }

    /// Hidden layers and an output layer over `rows`. `wanted` has the gradient of the first one's input.
    pub(super) fn layers(&mut self, rows: i64, input: i64, hidden: &[usize], output: i64, wanted: Gradients) {
        let outputs = hidden.iter().map(|size| *size as i64).chain((output > 0).then_some(output));
        outputs.enumerate().fold(input, |width, (index, size)| {
            let wanted = Gradients { input: wanted.input || (wanted.weights && index > 0), ..wanted };
            self.products.push(Product::new([rows, width, size], wanted, self.device));
            size
        });
    }

    /// Stacked LSTM layers over `rows` of the unrolls. Returns the width of the last one.
    pub(super) fn lstm(&mut self, rows: i64, input: i64, units: &[usize], wanted: Gradients) -> i64 {
        units.iter().fold(input, |width, units| {
            let size = [rows / self.unrolls, self.unrolls, width, *units as i64];
            self.lstms.push(FusedLstm::new(size, wanted, self.device));
            *units as i64
        })
    }

    /// One layer over `rows` of the unrolls.
    pub(super) fn layer(&mut self, rows: i64, layer: Layer) {
        match layer {
            Layer::Dense { input, output, flows_on } => {
                let wanted = Gradients { input: flows_on, ..Gradients::WEIGHTS };
                self.products.push(Product::new([rows, input as i64, output as i64], wanted, self.device));
            }
            Layer::Lstm { input, units } => {
                self.lstm(rows, input as i64, &[units], Gradients::BOTH);
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
