//! The value function.

use comic_experiment::{Network, TaskSpec};
use tch::{Kind, Tensor, nn};

use crate::layers::{Mlp, Torso, rows};
use crate::linear::Linear;
use crate::lstm::{LstmStack, RecurrentState};
use crate::normaliser::NormalisedObservation;
use crate::routing::PerTask;

/// V(x_t, s_t, clip), one network per task: `[x, s, clip embedding]` → torso → one output per reward term (CoMic
/// supplement).
///
/// A recurrent value function has LSTM layers after the torso. Their state is 0 at the first row of an unroll, and is
/// reset to 0 where an episode begins. Joint training has no recurrent value function.
///
/// The clip embedding is learned. Its initial entries are N(0, 1/width), so the length of a row is about 1.
#[derive(Debug)]
pub struct Value {
    /// One embedding per task, `[clips, width]`.
    embeddings: Vec<Tensor>,
    body: Body,
}

#[derive(Debug)]
enum Body {
    FeedForward(PerTask),
    Recurrent { torso: Torso, lstm: LstmStack, head: Linear },
}

impl Value {
    /// Creates the value's parameters in `store`.
    pub fn new(store: &nn::Path, spec: &TaskSpec, config: &Network) -> Self {
        let width = config.clip_embedding as i64;
        let stdev = 1.0 / (config.clip_embedding.max(1) as f64).sqrt();
        let image_features = if spec.image > 0 { config.image_features } else { 0 };
        let terms = spec.reward_terms.len() as i64;
        let (mut embeddings, mut networks) = (Vec::new(), Vec::new());
        for task in &spec.tasks {
            let path = store / task.name.as_str();
            let mut embedding = || {
                let size = [task.clips.max(1) as i64, width];
                embeddings.push(path.var("clip_embedding", &size, nn::Init::Randn { mean: 0.0, stdev }));
            };
            let input = (spec.proprioception + task.observation + image_features) as i64 + width;
            let torso = Torso::new(&path, input, &config.value);
            if !config.value_lstm.is_empty() {
                let lstm = LstmStack::new(&path, torso.output(), &config.value_lstm);
                let head = Linear::new(&(&path / "head"), lstm.output(), terms, 1.0);
                embedding();
                return Self { embeddings, body: Body::Recurrent { torso, lstm, head } };
            }
            let head = Linear::new(&(&path / "head"), torso.output(), terms, 1.0);
            embedding();
            networks.push(Mlp::new(torso, head, None));
        }
        Self { embeddings, body: Body::FeedForward(PerTask::new(networks)) }
    }

    /// The values `[B, T, R]` of observations `[B, T, ·]`. `clip` has the indices of the clips, `[B, T]` int64, below
    /// the number of clips of all tasks. `first` is 1 where an episode begins, `[B, T]`.
    pub fn forward(&self, observation: &NormalisedObservation, clip: &Tensor, first: &Tensor) -> Tensor {
        let NormalisedObservation { proprioception, task, routing } = observation;
        // The indices of clips continue from task to task.
        let embedded = Tensor::embedding(&Tensor::cat(&self.embeddings, 0), clip, -1, false, false);
        let input = rows(&Tensor::cat(&[task, proprioception, &embedded], -1));
        let (unrolls, steps) = (clip.size()[0], clip.size()[1]);
        let values = match &self.body {
            Body::FeedForward(networks) => networks.forward(&input, routing),
            Body::Recurrent { torso, lstm, head } => {
                let state = Tensor::zeros([unrolls, lstm.state_size()], (Kind::Float, input.device()));
                let recurrent = RecurrentState { state: &state, first: Some(first) };
                let hidden = torso.forward(&input).reshape([unrolls, steps, -1]);
                lstm.forward(&hidden, recurrent).0.flatten(0, 1).apply(head)
            }
        };
        values.reshape([unrolls, steps, -1])
    }
}
