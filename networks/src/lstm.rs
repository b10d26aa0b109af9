//! Recurrent layers.

use tch::{Tensor, nn};

use crate::linear::{Linear, Matrix};

/// Stacked LSTM layers. Their state is a row: hidden and cell state of the first layer, then of the next.
#[derive(Debug)]
pub(crate) struct LstmStack {
    layers: Vec<LstmLayer>,
}

/// The recurrent state at the start of unrolls, and where it is reset within them.
#[derive(Clone, Copy, Debug)]
pub struct RecurrentState<'a> {
    /// The state before the first row of each unroll, `[B, S]`. S is 0 for networks that are not recurrent.
    pub state: &'a Tensor,
    /// 1 where an episode begins and the state is reset to 0, `[B, T]`. `None` if the caller has reset the state, as
    /// when acting.
    pub first: Option<&'a Tensor>,
}

impl LstmStack {
    /// `units` has at least one entry; the check of the experiment refuses an empty list.
    pub(crate) fn new(path: &nn::Path, input: i64, units: &[usize]) -> Self {
        let mut width = input;
        let layers = units
            .iter()
            .enumerate()
            .map(|(index, units)| {
                let layer = LstmLayer::new(&(path / "lstm" / index), width, *units as i64);
                width = *units as i64;
                layer
            })
            .collect();
        Self { layers }
    }

    /// H, the units of the last layer.
    pub(crate) fn output(&self) -> i64 {
        self.layers.last().map_or(0, |layer| layer.units)
    }

    /// S, the size of the state.
    pub(crate) fn state_size(&self) -> i64 {
        self.layers.iter().map(|layer| 2 * layer.units).sum()
    }

    /// From `[B, T, I]` to `[B, T, H]`. Also returns the state after the last step, `[B, S]`.
    pub(crate) fn forward(&self, input: &Tensor, recurrent: RecurrentState<'_>) -> (Tensor, Tensor) {
        // [T, B, 1]: 0 where an episode begins, else 1.
        let kept = recurrent.first.map(|first| {
            let kept: Tensor = 1.0 - first.tr();
            kept.unsqueeze(-1)
        });
        let mut hidden = input.transpose(0, 1);
        let mut start = 0;
        let mut states = Vec::with_capacity(2 * self.layers.len());
        for layer in &self.layers {
            let part = |offset: i64| recurrent.state.narrow(1, start + offset, layer.units);
            let (h, c) = (part(0), part(layer.units));
            start += 2 * layer.units;
            let (output, h, c) = layer.forward(&hidden, h, c, kept.as_ref());
            hidden = output;
            states.extend([h, c]);
        }
        (hidden.transpose(0, 1), Tensor::cat(&states, 1))
    }
}

/// One layer, in PyTorch's order of gates: input, forget, cell, output.
#[derive(Debug)]
struct LstmLayer {
    input: Linear,
    /// `[4·units, units]`.
    recurrent: Matrix,
    units: i64,
}

impl LstmLayer {
    fn new(path: &nn::Path, input: i64, units: i64) -> Self {
        let bound = 1.0 / (units as f64).sqrt();
        let input = Linear::new(&(path / "input"), input, 4 * units, 1.0);
        // The forget gate is open initially, so gradients reach back through time from the beginning (D).
        let _ = tch::no_grad(|| input.bias.narrow(0, units, units).fill_(1.0));
        let recurrent = path.var("recurrent", &[4 * units, units], nn::Init::Uniform { lo: -bound, up: bound });
        Self { input, recurrent: Matrix::new(recurrent), units }
    }

    /// From `input` `[T, B, I]` to `[T, B, units]`, with `h` and `c` `[B, units]` and `kept` `[T, B, 1]`. Also returns
    /// the last h and c.
    ///
    /// The product with the input is one product for all steps; each step then needs only one small product.
    fn forward(&self, input: &Tensor, mut h: Tensor, mut c: Tensor, kept: Option<&Tensor>) -> (Tensor, Tensor, Tensor) {
        let projected = input.apply(&self.input);
        // One `unbind` splits all steps at once, so its gradient is assembled once. The gradient of a single selected
        // step would be as large as the whole tensor and nearly all zeros.
        let mut kept = kept.map(|kept| kept.unbind(0).into_iter());
        let mut outputs = Vec::with_capacity(projected.size()[0] as usize);
        for projected in projected.unbind(0) {
            if let Some(kept) = kept.as_mut().and_then(Iterator::next) {
                (h, c) = (h * &kept, c * kept);
            }
            let gates = self.recurrent.add_product(&projected, &h).split(self.units, 1);
            let [input, forget, output] = [0, 1, 3].map(|gate| gates[gate].sigmoid());
            c = (forget * c).addcmul(&input, &gates[2].tanh());
            h = output * c.tanh();
            outputs.push(h.shallow_clone());
        }
        (Tensor::stack(&outputs, 0), h, c)
    }
}
