//! SVG(0) with Retrace, the algorithm of the paper's transfer experiments.

use serde::{Deserialize, Serialize};

/// SVG(0) (Heess et al., 2015) with Retrace (Munos et al., 2016). (S) is the CoMic supplement; (A) the published agent
/// `svg0_prior` of the same group; (N) said nowhere.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Svg0 {
    /// γ (A).
    pub discount: f64,
    /// Adam's learning rate (A).
    pub learning_rate: f64,
    /// Gradient steps between two copies of the target networks (A).
    pub target_period: u64,
    /// λ of Retrace (A).
    pub lambda: f64,
    /// Actions that are sampled for the value of a state and for the policy's gradient (A).
    pub action_samples: usize,
    /// Weight of the policy's entropy (A).
    pub entropy: f64,
    /// Weight of the KL divergence to N(0, I) (A).
    pub kl: f64,
    /// Sequences of a gradient step (N).
    pub minibatch_sequences: usize,
    /// Rows at the start of a sequence that only build up the recurrent states (N; R2D2).
    pub burn_in: usize,
    /// Hidden sizes of the encoders of proprioception and task (N).
    pub encoder: Vec<usize>,
    /// Units of the core's LSTM (S).
    pub core: usize,
    /// Units of the policy's LSTM (S).
    pub policy: usize,
    /// Hidden sizes of the action value (S: one layer of 256).
    pub action_value: Vec<usize>,
    /// Environment steps in the replay (A: a million items).
    pub replay_steps: usize,
    /// Most memory of the replay, MiB.
    pub replay_mib: u64,
    /// Sequences sampled for each sequence inserted (A: 32 with many actors).
    pub samples_per_insert: f64,
    /// Environment steps in the replay before the first gradient step (N).
    pub begin_at: usize,
}

impl Default for Svg0 {
    fn default() -> Self {
        Self {
            discount: 0.99,
            learning_rate: 1e-4,
            target_period: 100,
            lambda: 1.0,
            action_samples: 10,
            entropy: 1e-3,
            kl: 1e-3,
            minibatch_sequences: 64,
            burn_in: 8,
            encoder: vec![256],
            core: 128,
            policy: 128,
            action_value: vec![256],
            replay_steps: 1_000_000,
            replay_mib: 16_384,
            samples_per_insert: 32.0,
            begin_at: 100_000,
        }
    }
}
