//! The image encoder: from a camera image to features.

use comic_experiment::IMAGE_SIZE;
use tch::{Kind, Tensor, nn};

use crate::linear::Linear;

/// Two convolutions, each followed by ELU (8×8 with stride 4 to 16 channels, 4×4 with stride 2 to 32 channels), then
/// Linear → LayerNorm → tanh.
///
/// The sizes are this project's choice (D): small enough for two cores. The supplement does not specify images with
/// V-MPO; its ResNet belongs to the off-policy transfer.
#[derive(Debug)]
pub(crate) struct ImageEncoder {
    first: nn::Conv2D,
    second: nn::Conv2D,
    output: Linear,
    norm: nn::LayerNorm,
    features: i64,
}

/// Height and width of an image, pixels.
const SIZE: i64 = IMAGE_SIZE as i64;
/// Size of the second convolution's output: 32 channels of 6×6 from 64×64 pixels.
const SECOND: i64 = 32 * 6 * 6;

impl ImageEncoder {
    pub(crate) fn new(path: &nn::Path, features: i64) -> Self {
        let convolution = |name: &str, input: i64, output: i64, size: i64, stride: i64| {
            let bound = 1.0 / ((input * size * size) as f64).sqrt();
            let config = nn::ConvConfig {
                stride,
                ws_init: nn::Init::Uniform { lo: -bound, up: bound },
                bs_init: nn::Init::Const(0.0),
                ..nn::ConvConfig::default()
            };
            nn::conv2d(path / name, input, output, size, config)
        };
        Self {
            first: convolution("first", 3, 16, 8, 4),
            second: convolution("second", 16, 32, 4, 2),
            output: Linear::new(&(path / "output"), SECOND, features, 1.0),
            norm: nn::layer_norm(path / "norm", vec![features], nn::LayerNormConfig::default()),
            features,
        }
    }

    /// The number of weights of an encoder with so many features.
    pub(crate) fn weights(features: usize) -> u64 {
        let [first, second] = [(3 * 8 * 8, 16), (16 * 4 * 4, 32)].map(|(input, output)| input * output);
        first + second + SECOND.cast_unsigned() * features as u64
    }

    /// F, the number of features.
    pub(crate) fn output(&self) -> i64 {
        self.features
    }

    /// From pixels `[.., 64·64·3]`, uint8, red, green and blue, row by row, to features `[.., F]` in [−1, 1].
    pub(crate) fn forward(&self, image: &Tensor) -> Tensor {
        let mut shape = image.size();
        shape.pop();
        shape.push(self.features);
        // The trace of an exported policy must not contain the number of images.
        shape[0] = -1;
        let pixels = image.reshape([-1, SIZE, SIZE, 3]).permute([0, 3, 1, 2]).to_kind(Kind::Float) / 255.0 - 0.5;
        let channels = pixels.apply(&self.first).elu_().apply(&self.second).elu_().flatten(1, -1);
        channels.apply(&self.output).apply(&self.norm).tanh_().reshape(shape)
    }
}
