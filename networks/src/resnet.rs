//! The residual network of images (CoMic supplement 2.5: "a small ResNet").

use comic_experiment::IMAGE_SIZE;
use tch::{Kind, Tensor, nn};

use crate::linear::Linear;

/// Channels of the sections (N): those of IMPALA's deep network (Espeholt et al., 2018, figure 3).
const CHANNELS: [i64; 3] = [16, 32, 32];
/// Height and width of an image, pixels.
const SIZE: i64 = IMAGE_SIZE as i64;
/// Height and width after the sections, of which each halves them.
const LAST: i64 = SIZE / 8;

/// IMPALA's residual network: three sections of a 3×3 convolution, 3×3 max-pooling with stride 2, and two residual blocks; then
/// ReLU and a linear layer with ReLU. A block adds to its input ReLU → 3×3 convolution → ReLU → 3×3 convolution.
#[derive(Debug)]
pub(crate) struct ResNet {
    sections: Vec<Section>,
    output: Linear,
    features: i64,
}

#[derive(Debug)]
struct Section {
    convolution: nn::Conv2D,
    blocks: [[nn::Conv2D; 2]; 2],
}

impl ResNet {
    /// Creates its parameters in `path`.
    pub(crate) fn new(path: &nn::Path, features: i64) -> Self {
        let convolution = |path: nn::Path, input: i64, output: i64| {
            let bound = 1.0 / ((input * 9) as f64).sqrt();
            let config = nn::ConvConfig {
                padding: 1,
                ws_init: nn::Init::Uniform { lo: -bound, up: bound },
                bs_init: nn::Init::Const(0.0),
                ..nn::ConvConfig::default()
            };
            nn::conv2d(path, input, output, 3, config)
        };
        let mut input = 3;
        let sections = CHANNELS.into_iter().enumerate().map(|(index, channels)| {
            let path = path / "sections" / index;
            let block =
                |index: usize| [0, 1].map(|layer| convolution(&path / "blocks" / index / layer, channels, channels));
            let first = convolution(&path / "convolution", input, channels);
            input = channels;
            Section { convolution: first, blocks: [0, 1].map(block) }
        });
        let sections = sections.collect();
        let flat = CHANNELS[CHANNELS.len() - 1] * LAST * LAST;
        Self { sections, output: Linear::new(&(path / "output"), flat, features, 1.0), features }
    }

    /// The number of weights of a network with so many features.
    pub(crate) fn weights(features: usize) -> u64 {
        let [first, second, third] = CHANNELS.map(i64::cast_unsigned);
        // Each section has a convolution of its input, and two blocks of two.
        let sections = [(3, first), (first, second), (second, third)];
        let convolutions: u64 = sections.iter().map(|(input, output)| 9 * output * (input + 4 * output)).sum();
        let flat = third * (LAST * LAST).cast_unsigned();
        convolutions + flat * features as u64
    }

    /// F, the number of features.
    pub(crate) fn output(&self) -> i64 {
        self.features
    }

    /// From pixels `[.., 64·64·3]`, uint8, red, green and blue, row by row, to features `[.., F]`, at least 0.
    pub(crate) fn forward(&self, image: &Tensor) -> Tensor {
        let mut shape = image.size();
        shape.pop();
        shape.push(self.features);
        // The trace of an exported policy must not contain the number of images.
        shape[0] = -1;
        let pixels = image.reshape([-1, SIZE, SIZE, 3]).permute([0, 3, 1, 2]).to_kind(Kind::Float) / 255.0 - 0.5;
        let channels = self.sections.iter().fold(pixels, |input, section| section.forward(&input));
        channels.relu().flatten(1, -1).apply(&self.output).relu().reshape(shape)
    }
}

impl Section {
    fn forward(&self, input: &Tensor) -> Tensor {
        let pooled = input.apply(&self.convolution).max_pool2d([3, 3], [2, 2], [1, 1], [1, 1], false);
        self.blocks.iter().fold(pooled, |input, [first, second]| {
            let change = input.relu().apply(first).relu().apply(second);
            input + change
        })
    }
}
