//! Building blocks of encoder, low level and value.

use comic_experiment::Network;
use tch::{Tensor, nn};

use crate::gaussian::DiagonalGaussian;
use crate::linear::{Activation, Linear, Matrix, forward_through};
use crate::packed::LAYER_NORM_EPSILON;

/// Reshapes `[.., D]` to rows `[N, D]`. The trace of an exported policy must not contain their number.
pub(crate) fn rows(tensor: &Tensor) -> Tensor {
    let size = tensor.size();
    match size.split_last() {
        None => tensor.reshape([1, 1]),
        Some((_, [_])) => tensor.shallow_clone(),
        Some((width, _)) if *width > 0 => tensor.reshape([-1, *width]),
        // −1 is ambiguous if the width is 0.
        Some((width, leading)) => tensor.reshape([leading.iter().product(), *width]),
    }
}

/// Hidden layers: Linear → LayerNorm → tanh first, then Linear → ELU.
#[derive(Debug)]
pub(crate) struct Torso {
    layers: Vec<Linear>,
    norm: [Tensor; 2],
    output: i64,
}

impl Torso {
    /// `sizes` has at least one entry; the check of the experiment refuses an empty list.
    pub(crate) fn new(path: &nn::Path, input: i64, sizes: &[usize]) -> Self {
        let first = sizes.first().map_or(input, |size| *size as i64);
        let mut width = first;
        let mut layers = Vec::new();
        for (index, size) in sizes.iter().enumerate().skip(1) {
            layers.push(Linear::new(&(path / "layers" / index), width, *size as i64, 1.0));
            width = *size as i64;
        }
        layers.insert(0, Linear::new(&(path / "layers" / 0), input, first, 1.0));
        let norm = path / "norm";
        let norm =
            [norm.var("weight", &[first], nn::Init::Const(1.0)), norm.var("bias", &[first], nn::Init::Const(0.0))];
        Self { layers, norm, output: width }
    }

    /// Width of the last hidden layer.
    pub(crate) fn output(&self) -> i64 {
        self.output
    }

    /// From `[N, input]` to `[N, output]`.
    pub(crate) fn forward(&self, input: &Tensor) -> Tensor {
        forward_through(&self.layers(), input)
    }

    fn layers(&self) -> Vec<(&Linear, Activation<'_>)> {
        let activation = |index| if index == 0 { Activation::NormTanh(&self.norm) } else { Activation::Elu };
        self.layers.iter().enumerate().map(|(index, layer)| (layer, activation(index))).collect()
    }
}

/// Hidden layers and a linear output, with an optional linear path from input to output.
#[derive(Debug)]
pub(crate) struct Mlp {
    torso: Torso,
    head: Linear,
    /// `[output, input]`.
    linear_path: Option<Matrix>,
}

impl Mlp {
    pub(crate) fn new(torso: Torso, head: Linear, linear_path: Option<Matrix>) -> Self {
        Self { torso, head, linear_path }
    }

    /// Width of its input.
    pub(crate) fn input(&self) -> i64 {
        self.torso.layers.first().map_or(0, |layer| layer.matrix.weights().size()[1])
    }

    /// From `[N, input]` to `[N, output]`.
    pub(crate) fn forward(&self, input: &Tensor) -> Tensor {
        let mut layers = self.torso.layers();
        layers.push((&self.head, Activation::Linear));
        let output = forward_through(&layers, input);
        match &self.linear_path {
            Some(path) => path.add_product(&output, input),
            None => output,
        }
    }
}

/// Runs each group of rows through its own network: from `[G, N, input]` to `[G, N, output]`. `chosen`, int64 `[G]`,
/// has the index of each group's network. The networks have the same sizes except for their inputs; a network reads
/// only the last entries of the input.
///
/// The choice of networks is data, so one compiled program works for every choice. The cost is a copy of the parameters
/// for every group.
pub(crate) fn forward_chosen(networks: &[Mlp], chosen: &Tensor, input: &Tensor) -> Tensor {
    let choose = |of: &dyn Fn(&Mlp) -> Tensor| {
        let all: Vec<Tensor> = networks.iter().map(of).collect();
        Tensor::stack(&all, 0).index_select(0, chosen)
    };
    // The weights of entries that a network does not read are 0.
    let widened = |weights: &Tensor, width: i64| weights.constant_pad_nd([width - weights.size()[1], 0]);
    let linear = |input: &Tensor, of: &dyn Fn(&Mlp) -> &Linear| {
        let weights = choose(&|network| widened(of(network).matrix.weights(), input.size()[2]));
        let biases = choose(&|network| of(network).bias.shallow_clone());
        input.matmul(&weights.transpose(1, 2)) + biases.unsqueeze(1)
    };
    let hidden = linear(input, &|network| &network.torso.layers[0]);
    let [weight, bias] = [0, 1].map(|part| choose(&|network| network.torso.norm[part].shallow_clone()).unsqueeze(1));
    let normalised = hidden.layer_norm([hidden.size()[2]], None::<Tensor>, None::<Tensor>, LAYER_NORM_EPSILON, true);
    // The activation is in place: torch_xla 2.9 computes ELU's gradient from its output, which is correct only for
    // `elu_`.
    let mut hidden = (normalised * weight + bias).tanh_();
    for layer in 1..networks.first().map_or(0, |network| network.torso.layers.len()) {
        hidden = linear(&hidden, &|network| &network.torso.layers[layer]).elu_();
    }
    let output = linear(&hidden, &|network| &network.head);
    match networks.iter().map(|network| network.linear_path.as_ref()).collect::<Option<Vec<_>>>() {
        Some(paths) => {
            let weights: Vec<Tensor> = paths.iter().map(|path| widened(path.weights(), input.size()[2])).collect();
            output + input.matmul(&Tensor::stack(&weights, 0).index_select(0, chosen).transpose(1, 2))
        }
        None => output,
    }
}

/// Initial values of a Gaussian head.
pub(crate) struct GaussianHeadConfig<'a> {
    /// Initial bias of the mean, one entry per dimension.
    pub(crate) mean: &'a [f32],
    /// Initial standard deviation, if the contribution of the weights is 0.
    pub(crate) initial_std: f64,
    /// Least standard deviation.
    pub(crate) min_std: f64,
    /// Factor of the initial weights, relative to other layers.
    pub(crate) scale: f64,
}

impl<'a> GaussianHeadConfig<'a> {
    /// For actions whose initial mean is `pose`.
    pub(crate) fn of_actions(pose: &'a [f32], network: &Network) -> Self {
        Self {
            mean: pose,
            initial_std: network.initial_std,
            min_std: network.min_std,
            scale: network.policy_head_scale,
        }
    }

    /// The linear layer whose output is the mean, followed by the raw standard deviation. The initial bias of the raw
    /// half gives σ = initial_std.
    pub(crate) fn linear(&self, path: &nn::Path, input: i64) -> Linear {
        let layer = Linear::new(path, input, 2 * self.mean.len() as i64, self.scale);
        let raw = inverse_softplus(self.initial_std - self.min_std) as f32;
        let bias: Vec<f32> = self.mean.iter().copied().chain(std::iter::repeat_n(raw, self.mean.len())).collect();
        tch::no_grad(|| layer.bias.shallow_clone().copy_(&Tensor::from_slice(&bias)));
        layer
    }
}

/// Gaussians `[N, D]` from means, followed by raw standard deviations, `[N, 2·D]`: σ = min_std + softplus(raw).
pub(crate) fn gaussian(output: &Tensor, min_std: f64) -> DiagonalGaussian {
    let size = output.size()[1] / 2;
    let std = output.narrow(1, size, size).softplus() + min_std;
    DiagonalGaussian { mean: output.narrow(1, 0, size), std }
}

/// Hidden layers, and a linear layer whose output is a Gaussian.
#[derive(Debug)]
pub(crate) struct GaussianMlp {
    mlp: Mlp,
    min_std: f64,
}

impl GaussianMlp {
    pub(crate) fn new(path: &nn::Path, input: i64, sizes: &[usize], config: &GaussianHeadConfig) -> Self {
        let torso = Torso::new(path, input, sizes);
        let head = config.linear(&(path / "head"), torso.output());
        Self { mlp: Mlp::new(torso, head, None), min_std: config.min_std }
    }

    /// From `[N, input]` to Gaussians `[N, D]`.
    pub(crate) fn forward(&self, input: &Tensor) -> DiagonalGaussian {
        gaussian(&self.mlp.forward(input), self.min_std)
    }
}

/// A linear layer whose output is a Gaussian.
#[derive(Debug)]
pub(crate) struct GaussianHead {
    head: Linear,
    min_std: f64,
}

impl GaussianHead {
    pub(crate) fn new(path: &nn::Path, input: i64, config: &GaussianHeadConfig) -> Self {
        Self { head: config.linear(&(path / "head"), input), min_std: config.min_std }
    }

    /// From `hidden` `[N, H]` to Gaussians `[N, D]`.
    pub(crate) fn forward(&self, hidden: &Tensor) -> DiagonalGaussian {
        gaussian(&hidden.apply(&self.head), self.min_std)
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
    fn inverse_softplus_inverts_softplus_from_tiny_to_large() {
        for y in [1e-6, 0.05, std::f64::consts::LN_2, 3.0, 50.0, 1000.0] {
            let raw = inverse_softplus(y);
            let softplus = if raw > 30.0 { raw } else { raw.exp().ln_1p() };
            assert!((softplus - y).abs() <= 1e-9 * y.max(1e-3), "{y}: {softplus}");
        }
    }
}
