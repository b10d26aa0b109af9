//! Linear layers, in learning and in acting.

#![allow(unsafe_code, reason = "tch gives the memory of a tensor as a pointer only")]

use std::cell::{Cell, Ref, RefCell};
use std::ops::RangeInclusive;

use tch::{Device, Kind, Tensor, nn};

use crate::packed::{self, LAYER_NORM_EPSILON, Layer, Packed, add_layers};

/// The numbers of rows for which [`Packed`] is used. For a single row it would compute 16, where libtorch takes as long as the
/// memory; for many rows libtorch's products are nearly as fast, and use all threads.
const FEW_ROWS: RangeInclusive<i64> = 2..=128;

thread_local! {
    static ACTING: Cell<bool> = const { Cell::new(false) };
}

/// Runs `act` without gradients, and on a CPU with layers for few rows, whose weights are packed once for each version of the
/// parameters. The results differ from libtorch's by rounding. No gradient of a parameter can be had in here.
///
/// A policy that is traced must not act in here: a trace has libtorch's operations only.
pub fn acting<T>(act: impl FnOnce() -> T) -> T {
    struct Restore(bool);
    impl Drop for Restore {
        fn drop(&mut self) {
            ACTING.set(self.0);
        }
    }
    let _restore = Restore(ACTING.replace(true));
    tch::no_grad(act)
}

/// A matrix of weights, `[outputs, inputs]`, which a row is multiplied with.
#[derive(Debug)]
pub(crate) struct Matrix {
    weights: Tensor,
    /// The version of the parameters that is packed, and its weights for acting.
    packed: RefCell<(Option<i64>, Packed)>,
}

impl Matrix {
    pub(crate) fn new(weights: Tensor) -> Self {
        Self { weights, packed: RefCell::default() }
    }

    /// `[outputs, inputs]`.
    pub(crate) fn weights(&self) -> &Tensor {
        &self.weights
    }

    /// `start` + `input` · weightsᵀ, `[N, outputs]`, for `input` `[N, inputs]`. `start` is `[N, outputs]`, or a bias
    /// `[outputs]`.
    pub(crate) fn add_product(&self, start: &Tensor, input: &Tensor) -> Tensor {
        if !acts_on(input, self) {
            return start.addmm(input, &self.weights.tr());
        }
        let mut sums = Tensor::empty([input.size()[0], self.weights.size()[0]], (Kind::Float, Device::Cpu));
        sums.copy_(start);
        let layer = Layer { weights: &self.packed(), bias: &[], activation: packed::Function::Linear };
        add_layers(&[layer], memory(&input.contiguous()), memory_mut(&mut sums));
        sums
    }

    /// The weights for acting, of the parameters as they are now.
    fn packed(&self) -> Ref<'_, Packed> {
        // libtorch counts how often a tensor was changed in place. It does not count `set_data`, which nothing here uses.
        let version = self.weights.internal_version();
        if self.packed.borrow().0 != Some(version) {
            let packed = Packed::new(memory(&self.weights.contiguous()), self.weights.size()[1] as usize);
            *self.packed.borrow_mut() = (Some(version), packed);
        }
        Ref::map(self.packed.borrow(), |(_, packed)| packed)
    }
}

/// Whether [`Packed`] weights are used for these rows, `[N, inputs]`.
fn acts_on(input: &Tensor, matrix: &Matrix) -> bool {
    ACTING.get()
        && !input.requires_grad()
        && (input.device(), input.kind(), matrix.weights.kind()) == (Device::Cpu, Kind::Float, Kind::Float)
        && input.dim() == 2
        && input.size()[1] == matrix.weights.size()[1]
        && matrix.weights.numel() > 0
        && FEW_ROWS.contains(&input.size()[0])
}

/// The numbers of a contiguous float32 tensor on the CPU.
fn memory(tensor: &Tensor) -> &[f32] {
    let pointer = pointer(tensor);
    if pointer.is_null() {
        return &[];
    }
    // SAFETY: a contiguous tensor has so many numbers from this address on, and keeps them while it lives. Nothing in this crate
    // writes to a tensor that it borrows.
    unsafe { std::slice::from_raw_parts(pointer, tensor.numel()) }
}

/// The same of a tensor that nothing else shares.
fn memory_mut(tensor: &mut Tensor) -> &mut [f32] {
    let pointer = pointer(tensor);
    if pointer.is_null() {
        return &mut [];
    }
    // SAFETY: as above; the caller has made the tensor, and no other refers to its memory.
    unsafe { std::slice::from_raw_parts_mut(pointer, tensor.numel()) }
}

fn pointer(tensor: &Tensor) -> *mut f32 {
    assert!(
        tensor.is_contiguous() && (tensor.device(), tensor.kind()) == (Device::Cpu, Kind::Float),
        "{tensor:?} is no contiguous float32 on the CPU"
    );
    tensor.data_ptr().cast()
}

/// A linear layer with a bias.
#[derive(Debug)]
pub(crate) struct Linear {
    pub(crate) matrix: Matrix,
    /// `[outputs]`.
    pub(crate) bias: Tensor,
}

impl Linear {
    /// Weights uniform in ±`scale`/√inputs, and bias 0.
    pub(crate) fn new(path: &nn::Path, inputs: i64, outputs: i64, scale: f64) -> Self {
        let bound = scale / (inputs as f64).sqrt();
        let weights = if bound > 0.0 { nn::Init::Uniform { lo: -bound, up: bound } } else { nn::Init::Const(0.0) };
        let bias = path.var("bias", &[outputs], nn::Init::Const(0.0));
        Self { matrix: Matrix::new(path.var("weight", &[outputs, inputs], weights)), bias }
    }
}

impl nn::Module for Linear {
    /// From `[.., inputs]` to `[.., outputs]`.
    fn forward(&self, input: &Tensor) -> Tensor {
        if !ACTING.get() {
            return input.linear(self.matrix.weights(), Some(&self.bias));
        }
        let mut size = input.size();
        let output = self.matrix.add_product(&self.bias, &input.flatten(0, -2));
        size.pop();
        size.extend(self.bias.size());
        output.view(&size[..])
    }
}

/// What follows a linear layer.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Activation<'a> {
    /// Nothing.
    Linear,
    /// tanh of the layer norm with these parameters: scale and shift, `[outputs]` each.
    NormTanh(&'a [Tensor; 2]),
    /// ELU.
    Elu,
}

impl Activation<'_> {
    /// The activations work in place. That is correct because the gradients of layer norm and linear layers do not need
    /// their outputs. It saves a new 16 MB tensor per layer, which costs more than the arithmetic.
    fn apply(self, mut output: Tensor) -> Tensor {
        match self {
            Self::Linear => output,
            Self::NormTanh([scale, shift]) => {
                output.layer_norm(scale.size(), Some(scale), Some(shift), LAYER_NORM_EPSILON, true).tanh_()
            }
            Self::Elu => output.elu_(),
        }
    }

    fn packed(&self) -> packed::Function<'_> {
        match self {
            Self::Linear => packed::Function::Linear,
            Self::NormTanh([scale, shift]) => packed::Function::NormTanh { scale: memory(scale), shift: memory(shift) },
            Self::Elu => packed::Function::Elu,
        }
    }
}

/// Linear layers with their activations, one after another: from `[N, inputs]` to `[N, outputs]`.
pub(crate) fn forward_through(layers: &[(&Linear, Activation<'_>)], input: &Tensor) -> Tensor {
    if !layers.iter().all(|(layer, _)| acts_on(input, &layer.matrix)) {
        let forward =
            |hidden: Tensor, (layer, activation): &(&Linear, Activation<'_>)| activation.apply(hidden.apply(*layer));
        return layers.iter().fold(input.shallow_clone(), forward);
    }
    let weights: Vec<_> = layers.iter().map(|(layer, _)| layer.matrix.packed()).collect();
    let packed: Vec<_> = layers
        .iter()
        .zip(&weights)
        .map(|((layer, activation), weights)| Layer {
            weights,
            bias: memory(&layer.bias),
            activation: activation.packed(),
        })
        .collect();
    let outputs = layers.last().map_or(0, |(layer, _)| layer.bias.size()[0]);
    let mut output = Tensor::zeros([input.size()[0], outputs], (Kind::Float, Device::Cpu));
    add_layers(&packed, memory(&input.contiguous()), memory_mut(&mut output));
    output
}

#[cfg(test)]
mod tests {
    use tch::nn::Module as _;

    use super::*;

    fn layer() -> (nn::VarStore, Linear) {
        let store = nn::VarStore::new(Device::Cpu);
        let layer = Linear::new(&store.root(), 37, 11, 1.0);
        (store, layer)
    }

    fn input(rows: i64) -> Tensor {
        Tensor::linspace(-1.0, 1.0, rows * 37, (Kind::Float, Device::Cpu)).sin().view([rows, 37])
    }

    fn difference(one: &Tensor, other: &Tensor) -> f64 {
        (one - other).abs().max().double_value(&[])
    }

    #[test]
    fn a_layer_acts_as_it_learns() {
        let (_store, layer) = layer();
        for rows in [1, 2, 5, 16, 17, 128, 129] {
            let acted = acting(|| layer.forward(&input(rows)));
            assert!(difference(&acted, &layer.forward(&input(rows))) < 1e-6, "{rows} rows");
            assert!(!acted.requires_grad());
        }
    }

    #[test]
    fn changed_parameters_act_at_once() {
        let (store, layer) = layer();
        let before = acting(|| layer.forward(&input(3)));
        tch::no_grad(|| {
            for mut parameter in store.trainable_variables() {
                let _ = parameter.g_mul_scalar_(2.0);
            }
        });
        let after = acting(|| layer.forward(&input(3)));
        assert!(difference(&(before * 2.0), &after) < 1e-6);
    }

    #[test]
    fn the_gradient_of_an_input_that_wants_it_is_computed() {
        let (_store, layer) = layer();
        let input = input(3).set_requires_grad(true);
        let along = acting(|| tch::with_grad(|| layer.forward(&input).sum(Kind::Float)));
        along.backward();
        let expected = layer.matrix.weights().sum_dim_intlist(0i64, false, Kind::Float).expand([3, 37], false);
        assert!(difference(&input.grad(), &expected) < 1e-6);
    }
}
