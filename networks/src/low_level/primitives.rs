//! The parts of mixture and product: primitives and gate.

use tch::{Tensor, nn};

use super::interface::{Config, Input};
use super::size::{Layer, Sizes};
use crate::gaussian::DiagonalGaussian;
use crate::layers::{Mlp, Torso, inverse_softplus};
use crate::linear::Linear;

/// Largest fixed bias of a primitive's mean (S).
const LARGEST_BIAS: f64 = 0.66;

/// K Gaussians over actions that depend only on proprioception: a shared torso (S: 2×512), then a hidden layer (S: 256)
/// and a head for each primitive.
///
/// The heads have the same initial values as the MLP's head, with the given `initial_std`.
#[derive(Debug)]
pub(crate) struct Primitives {
    torso: Torso,
    /// The hidden layers of all primitives as one layer, `[K·hidden]`.
    hidden: Linear,
    /// `[K, hidden, 2·A]`.
    heads: Tensor,
    /// `[K, 1, 2·A]`.
    head_biases: Tensor,
    /// K numbers that are not trained, `[K, 1]`. Each is added to every dimension of one primitive's mean. A tensor that is made
    /// of numbers while a policy is traced would be zeros in the trace.
    fixed_biases: Option<Tensor>,
    count: i64,
    min_std: f64,
}

impl Primitives {
    pub(crate) fn new(path: &nn::Path, config: &Config<'_>, initial_std: f64) -> Self {
        let (network, sizes) = (config.network, &config.network.primitives);
        let (count, units, actions) = (sizes.count as i64, sizes.hidden as i64, config.pose.len() as i64);
        let path = path / "primitives";
        let torso = Torso::new(&path, config.proprioception, &sizes.torso);
        let hidden = Linear::new(&(&path / "hidden"), torso.output(), count * units, 1.0);
        let bound = network.policy_head_scale / (units as f64).sqrt();
        let weights = if bound > 0.0 { nn::Init::Uniform { lo: -bound, up: bound } } else { nn::Init::Const(0.0) };
        let heads = path.var("heads", &[count, units, 2 * actions], weights);
        let head_biases = path.var("head_biases", &[count, 1, 2 * actions], nn::Init::Const(0.0));
        let raw = inverse_softplus(initial_std - network.min_std) as f32;
        let bias: Vec<f32> = config.pose.iter().copied().chain(std::iter::repeat_n(raw, config.pose.len())).collect();
        let bias = Tensor::from_slice(&bias).expand_as(&head_biases);
        tch::no_grad(|| head_biases.shallow_clone().copy_(&bias));
        let fixed_biases = sizes.biases.then(|| Tensor::from_slice(&evenly(sizes.count)).unsqueeze(-1));
        Self { torso, hidden, heads, head_biases, fixed_biases, count, min_std: network.min_std }
    }

    /// From `[N, P]` to Gaussians `[N, K, A]`.
    pub(crate) fn forward(&self, proprioception: &Tensor) -> DiagonalGaussian {
        let hidden = self.torso.forward(proprioception).apply(&self.hidden).elu_();
        // [K, N, units]: the heads are one batched product.
        let hidden = hidden.unflatten(-1, [self.count, -1]).transpose(0, 1);
        let output = self.head_biases.baddbmm(&hidden, &self.heads, 1.0, 1.0).transpose(0, 1);
        let actions = output.size()[2] / 2;
        let mean = output.narrow(2, 0, actions);
        let mean = match &self.fixed_biases {
            Some(biases) => mean + biases.to_device(output.device()),
            None => mean,
        };
        let std = output.narrow(2, actions, actions).softplus() + self.min_std;
        DiagonalGaussian { mean, std }
    }
}

/// The layers that [`Primitives::new`] and [`Gate::new`] make.
pub(super) fn layers(sizes: &Sizes<'_>) -> Vec<Layer> {
    let network = sizes.network;
    let primitives = &network.primitives;
    let side_by_side = primitives.count * primitives.hidden;
    let mut layers = Layer::stack(sizes.proprioception, &[&primitives.torso[..], &[side_by_side]].concat());
    // The input of the first layer is an observation, so no gradient flows to it.
    if let Some(Layer::Dense { flows_on, .. }) = layers.first_mut() {
        *flows_on = false;
    }
    layers.extend(std::iter::repeat_n(Layer::dense(primitives.hidden, sizes.head()), primitives.count));
    if network.latent.size > 0 {
        layers.extend(Layer::stack(sizes.joined(), &[&primitives.gate[..], &[primitives.count]].concat()));
    }
    layers
}

/// `count` numbers, evenly spaced from −[`LARGEST_BIAS`] to [`LARGEST_BIAS`].
fn evenly(count: usize) -> Vec<f32> {
    let step = 2.0 * LARGEST_BIAS / (count.max(2) - 1) as f64;
    (0..count).map(|index| (index as f64 * step - LARGEST_BIAS) as f32).collect()
}

/// The gate: K unbounded numbers per row, which determine the weights of the primitives.
///
/// With a bottleneck: `[z, s]` → MLP (S: 2×400) → K. Without one, the encoder's output is these K numbers.
#[derive(Debug)]
pub(crate) struct Gate {
    bottleneck: Option<Mlp>,
}

impl Gate {
    pub(crate) fn new(path: &nn::Path, config: &Config<'_>) -> Self {
        let sizes = &config.network.primitives;
        let bottleneck = (config.network.latent.size > 0).then(|| {
            let path = path / "gate";
            let torso = Torso::new(&path, config.latent + config.proprioception, &sizes.gate);
            let head = Linear::new(&(&path / "head"), torso.output(), sizes.count as i64, 1.0);
            Mlp::new(torso, head, None)
        });
        Self { bottleneck }
    }

    /// K numbers per row, `[N, K]`.
    pub(crate) fn forward(&self, input: &Input<'_>) -> Tensor {
        match &self.bottleneck {
            Some(mlp) => mlp.forward(&Tensor::cat(&[input.intent, input.proprioception], 1)),
            None => input.intent.shallow_clone(),
        }
    }
}
