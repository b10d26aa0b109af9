//! The value function.

use comic_experiment::{Network, TaskSpec};
use tch::{Tensor, nn};

use crate::NormalisedObservation;
use crate::layers::{Torso, linear, rows};

/// V(x_t, s_t, clip): `[x, s, clip embedding]` → torso → one output per reward term (CoMic supplement).
///
/// The clip embedding is learned; its entries start as N(0, 1/width), so a row's length is about 1.
#[derive(Debug)]
pub struct Value {
    embedding: Tensor,
    torso: Torso,
    head: nn::Linear,
}

impl Value {
    /// Creates the value's parameters in `store`.
    pub fn new(store: &nn::Path, spec: &TaskSpec, config: &Network) -> Self {
        let width = config.clip_embedding as i64;
        let clips = spec.clips.len().max(1) as i64;
        let stdev = 1.0 / (config.clip_embedding.max(1) as f64).sqrt();
        let seen = if spec.image > 0 { config.image_features } else { 0 };
        let input = (spec.task + seen + spec.proprioception) as i64 + width;
        let torso = Torso::new(store, input, &config.value);
        let head = linear(&(store / "head"), torso.output(), spec.reward_terms.len() as i64, 1.0);
        let embedding = store.var("clip_embedding", &[clips, width], nn::Init::Randn { mean: 0.0, stdev });
        Self { embedding, torso, head }
    }

    /// Observations `[.., P]`, `[.., X]` and the clips' indices, `[..]` int64 below the number of clips; one row each
    /// out, `[N, R]`.
    pub fn forward(&self, observation: &NormalisedObservation, clip: &Tensor) -> Tensor {
        let clip = Tensor::embedding(&self.embedding, clip, -1, false, false);
        let input = rows(&Tensor::cat(&[&observation.task, &observation.proprioception, &clip], -1));
        self.torso.forward(&input).apply(&self.head)
    }
}
