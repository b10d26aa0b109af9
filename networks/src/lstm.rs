//! Recurrent layers.

use tch::{Tensor, nn};

use crate::layers::linear;

/// Stacked LSTM layers. Their state is a row of every layer's hidden and cell state, layer by layer.
#[derive(Debug)]
pub(crate) struct LstmStack {
    layers: Vec<LstmLayer>,
}

/// What was before, of whatever remembers.
#[derive(Clone, Copy, Debug)]
pub struct RecurrentState<'a> {
    /// What is remembered when the first row of each unroll is met, `[B, S]`; S is 0 for what remembers nothing.
    pub state: &'a Tensor,
    /// 1 where an episode begins, and all is forgotten, `[B, T]`; none where whoever acts has emptied the state itself.
    pub first: Option<&'a Tensor>,
}

impl LstmStack {
    /// `units` holds at least one entry; the experiment's check refuses an empty list.
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

    /// Units of the last layer.
    pub(crate) fn output(&self) -> i64 {
        self.layers.last().map_or(0, |layer| layer.units)
    }

    /// S.
    pub(crate) fn state_size(&self) -> i64 {
        self.layers.iter().map(|layer| 2 * layer.units).sum()
    }

    /// `[B, T, I]` to `[B, T, H]`, and the state after the last step, `[B, S]`.
    pub(crate) fn forward(&self, input: &Tensor, recurrent: RecurrentState<'_>) -> (Tensor, Tensor) {
        // 0 where an episode begins: [T, B, 1].
        let kept = recurrent.first.map(|first| {
            let kept: Tensor = 1.0 - first.tr();
            kept.unsqueeze(-1)
        });
        let mut hidden = input.transpose(0, 1);
        let mut place = 0;
        let mut states = Vec::with_capacity(2 * self.layers.len());
        for layer in &self.layers {
            let part = |offset: i64| recurrent.state.narrow(1, place + offset, layer.units);
            let (h, c) = (part(0), part(layer.units));
            place += 2 * layer.units;
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
    input: nn::Linear,
    /// `[4·units, units]`.
    recurrent: Tensor,
    units: i64,
}

impl LstmLayer {
    fn new(path: &nn::Path, input: i64, units: i64) -> Self {
        let bound = 1.0 / (units as f64).sqrt();
        let input = linear(&(path / "input"), input, 4 * units, 1.0);
        if let Some(bias) = &input.bs {
            // The forget gate starts open, so that a gradient reaches back from the first day (D).
            let _ = tch::no_grad(|| bias.narrow(0, units, units).fill_(1.0));
        }
        let recurrent = path.var("recurrent", &[4 * units, units], nn::Init::Uniform { lo: -bound, up: bound });
        Self { input, recurrent, units }
    }

    /// `input [T, B, I]`, `h` and `c` `[B, units]`, `kept [T, B, 1]`; gives `[T, B, units]` and the last h and c.
    ///
    /// What depends on the input alone is one product for all steps; what is left of a step is one small product.
    fn forward(&self, input: &Tensor, mut h: Tensor, mut c: Tensor, kept: Option<&Tensor>) -> (Tensor, Tensor, Tensor) {
        let projected = input.apply(&self.input);
        let recurrent = self.recurrent.tr();
        // Taken apart all at once, so that the gradient is put together once: of a part taken alone it is as large as the
        // whole, and nearly all zeros.
        let mut kept = kept.map(|kept| kept.unbind(0).into_iter());
        let mut outputs = Vec::with_capacity(projected.size()[0] as usize);
        for projected in projected.unbind(0) {
            if let Some(kept) = kept.as_mut().and_then(Iterator::next) {
                (h, c) = (h * &kept, c * kept);
            }
            let gates = projected.addmm(&h, &recurrent).split(self.units, 1);
            let [input, forget, output] = [0, 1, 3].map(|gate| gates[gate].sigmoid());
            c = (forget * c).addcmul(&input, &gates[2].tanh());
            h = output * c.tanh();
            outputs.push(h.shallow_clone());
        }
        (Tensor::stack(&outputs, 0), h, c)
    }
}
