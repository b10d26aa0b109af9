//! The building blocks that encoder, low level and value share.

use comic_experiment::Network;
use tch::{Tensor, nn};

use crate::DiagonalGaussian;

/// A linear layer with weights uniform in ±`scale`/√fan_in and bias 0.
pub(crate) fn linear(path: &nn::Path, input: i64, output: i64, scale: f64) -> nn::Linear {
    let bound = scale / (input as f64).sqrt();
    let weights = if bound > 0.0 { nn::Init::Uniform { lo: -bound, up: bound } } else { nn::Init::Const(0.0) };
    nn::linear(
        path,
        input,
        output,
        nn::LinearConfig { ws_init: weights, bs_init: Some(nn::Init::Const(0.0)), bias: true },
    )
}

/// `[.., D]` as rows `[N, D]`.
pub(crate) fn rows(tensor: &Tensor) -> Tensor {
    let size = tensor.size();
    let Some((width, leading)) = size.split_last() else { return tensor.reshape([1, 1]) };
    // Not −1, which cannot be told where the width is 0.
    tensor.reshape([leading.iter().product(), *width])
}

/// Hidden layers: Linear → LayerNorm → tanh first, then Linear → ELU.
#[derive(Debug)]
pub(crate) struct Torso {
    first: nn::Linear,
    norm: nn::LayerNorm,
    others: Vec<nn::Linear>,
    output: i64,
}

impl Torso {
    /// `sizes` holds at least one entry; the experiment file's check refuses an empty list.
    pub(crate) fn new(path: &nn::Path, input: i64, sizes: &[usize]) -> Self {
        let layers = path / "layers";
        let first_size = sizes.first().map_or(input, |size| *size as i64);
        let mut width = first_size;
        let mut others = Vec::new();
        for (index, size) in sizes.iter().enumerate().skip(1) {
            others.push(linear(&(&layers / index), width, *size as i64, 1.0));
            width = *size as i64;
        }
        Self {
            first: linear(&(&layers / 0), input, first_size, 1.0),
            norm: nn::layer_norm(path / "norm", vec![first_size], nn::LayerNormConfig::default()),
            others,
            output: width,
        }
    }

    /// Width of the last hidden layer.
    pub(crate) fn output(&self) -> i64 {
        self.output
    }

    /// `[N, input]` to `[N, output]`.
    ///
    /// The activations overwrite their inputs: neither the layer norm nor a linear layer needs its own output to
    /// differentiate itself, and a fresh 16 MB tensor a layer costs more than the arithmetic.
    pub(crate) fn forward(&self, input: &Tensor) -> Tensor {
        let mut hidden = input.apply(&self.first).apply(&self.norm).tanh_();
        for layer in &self.others {
            hidden = hidden.apply(layer).elu_();
        }
        hidden
    }
}

/// What a Gaussian head starts as.
pub(crate) struct GaussianHeadConfig<'a> {
    /// Where the mean's bias starts, one entry a dimension.
    pub(crate) mean: &'a [f32],
    /// The standard deviation where the head's weights contribute nothing.
    pub(crate) initial_std: f64,
    /// Floor of the standard deviation.
    pub(crate) min_std: f64,
    /// Scale of the initial weights, relative to the other layers'.
    pub(crate) scale: f64,
    /// Width of a linear path's input, if there is one.
    pub(crate) linear_path: Option<i64>,
}

impl<'a> GaussianHeadConfig<'a> {
    /// For actions whose mean starts at `pose`.
    pub(crate) fn of_actions(pose: &'a [f32], network: &Network) -> Self {
        Self {
            mean: pose,
            initial_std: network.initial_std,
            min_std: network.min_std,
            scale: network.policy_head_scale,
            linear_path: None,
        }
    }
}

/// One linear layer whose outputs are the mean and the raw standard deviation, side by side:
/// σ = min_std + softplus(raw). The raw half's bias starts at the c for which σ = initial_std.
#[derive(Debug)]
pub(crate) struct GaussianHead {
    head: nn::Linear,
    linear_path: Option<Tensor>,
    size: i64,
    min_std: f64,
}

impl GaussianHead {
    pub(crate) fn new(path: &nn::Path, input: i64, config: &GaussianHeadConfig) -> Self {
        let size = config.mean.len() as i64;
        let head = linear(&(path / "head"), input, 2 * size, config.scale);
        let raw = inverse_softplus(config.initial_std - config.min_std) as f32;
        let bias: Vec<f32> = config.mean.iter().copied().chain(std::iter::repeat_n(raw, config.mean.len())).collect();
        if let Some(parameter) = &head.bs {
            tch::no_grad(|| parameter.shallow_clone().copy_(&Tensor::from_slice(&bias)));
        }
        // At zero: raw observations reach hundreds (contact forces), and must not decide where the latent starts.
        let linear_path =
            config.linear_path.map(|width| path.var("linear_path", &[2 * size, width], nn::Init::Const(0.0)));
        Self { head, linear_path, size, min_std: config.min_std }
    }

    /// `hidden [N, H]`, and `input [N, I]` for the linear path.
    pub(crate) fn forward(&self, hidden: &Tensor, input: &Tensor) -> DiagonalGaussian {
        let mut output = hidden.apply(&self.head);
        if let Some(weights) = &self.linear_path {
            output = output.addmm(input, &weights.tr());
        }
        let mean = output.narrow(1, 0, self.size);
        let std = output.narrow(1, self.size, self.size).softplus() + self.min_std;
        DiagonalGaussian { mean, std }
    }
}

/// softplus⁻¹ for positive `y`: y + ln(1 − e^{−y}).
pub(crate) fn inverse_softplus(y: f64) -> f64 {
    y + (-(-y).exp_m1()).ln()
}

#[cfg(test)]
mod tests {
    use super::inverse_softplus;

    #[test]
    pub(crate) fn inverse_softplus_undoes_softplus_from_tiny_to_large() {
        for y in [1e-6, 0.05, std::f64::consts::LN_2, 3.0, 50.0, 1000.0] {
            let raw = inverse_softplus(y);
            let softplus = if raw > 30.0 { raw } else { raw.exp().ln_1p() };
            assert!((softplus - y).abs() <= 1e-9 * y.max(1e-3), "{y}: {softplus}");
        }
    }
}
