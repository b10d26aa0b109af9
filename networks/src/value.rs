//! The value function.

use comic_experiment::{Network, TaskSpec};
use tch::{Kind, Tensor, nn};

use crate::NormalisedObservation;
use crate::layers::{Torso, linear, rows};
use crate::lstm::{LstmStack, Memory};

/// V(x_t, s_t, clip): `[x, s, clip embedding]` → torso → one output per reward term (CoMic supplement). A recurrent one
/// has LSTM layers after the torso, which begin empty at an unroll's first row and are emptied where an episode begins.
///
/// The clip embedding is learned; its entries start as N(0, 1/width), so a row's length is about 1.
#[derive(Debug)]
pub struct Value {
    embedding: Tensor,
    torso: Torso,
    lstm: Option<LstmStack>,
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
        let lstm = (!config.value_lstm.is_empty()).then(|| LstmStack::new(store, torso.output(), &config.value_lstm));
        let hidden = lstm.as_ref().map_or(torso.output(), LstmStack::output);
        let head = linear(&(store / "head"), hidden, spec.reward_terms.len() as i64, 1.0);
        let embedding = store.var("clip_embedding", &[clips, width], nn::Init::Randn { mean: 0.0, stdev });
        Self { embedding, torso, lstm, head }
    }

    /// Observations `[B, T, P]`, `[B, T, X]`, the clips' indices, `[B, T]` int64 below the number of clips, and where
    /// episodes begin, `[B, T]`; `[B, T, R]` out.
    pub fn forward(&self, observation: &NormalisedObservation, clip: &Tensor, first: &Tensor) -> Tensor {
        let embedded = Tensor::embedding(&self.embedding, clip, -1, false, false);
        let input = rows(&Tensor::cat(&[&observation.task, &observation.proprioception, &embedded], -1));
        let (unrolls, steps) = (clip.size()[0], clip.size()[1]);
        let mut hidden = self.torso.forward(&input);
        if let Some(lstm) = &self.lstm {
            let state = Tensor::zeros([unrolls, lstm.state_size()], (Kind::Float, hidden.device()));
            let memory = Memory { state: &state, first: Some(first) };
            hidden = lstm.forward(&hidden.reshape([unrolls, steps, -1]), memory).0.flatten(0, 1);
        }
        hidden.apply(&self.head).reshape([unrolls, steps, -1])
    }
}
