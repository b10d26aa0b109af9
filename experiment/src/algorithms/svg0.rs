//! SVG(0) with Retrace, the algorithm of the paper's transfer experiments.

use serde::{Deserialize, Serialize};

use super::{AlgorithmParameters, Rest, layers};
use crate::fault::{AT_LEAST_ONE, Fault, NOT_NEGATIVE, ensure, not_negative};

/// SVG(0) (Heess et al., 2015) with Retrace (Munos et al., 2016). (S) is the CoMic supplement; (A) the published agent
/// `svg0_prior` of the same group; (N) said nowhere.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Svg0 {
    /// γ (A).
    pub discount: f64,
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
    /// The policy's standard deviation before learning (N).
    pub initial_std: f64,
    /// Its smallest standard deviation (N; A: 0.1).
    pub min_std: f64,
    /// Hidden sizes of the action value (S: one layer of 256).
    pub action_value: Vec<usize>,
    /// Gradient steps from one published version of the parameters to the next (N; A: an actor asks for new ones at least every
    /// 1,000 environment steps).
    pub publish_period: u64,
}

impl Default for Svg0 {
    fn default() -> Self {
        Self {
            discount: 0.99,
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
            initial_std: 0.7,
            min_std: 0.3,
            action_value: vec![256],
            publish_period: 10,
        }
    }
}

/// What SVG(0) does not read: it has networks of its own, and it learns from unrolls of every age.
const UNREAD: [&str; 16] = [
    "joint",
    "network.encoder",
    "network.encoder_linear_path",
    "network.value",
    "network.value_lstm",
    "network.clip_embedding",
    "network.latent.beta",
    "network.latent.prior",
    "network.latent.initial_std",
    "network.latent.min_std",
    "network.initial_std",
    "network.final_std",
    "network.min_std",
    "network.initial_pose",
    "optimiser.multiplier_learning_rate",
    "unroll.max_staleness",
];

/// What it does not read either where no frozen low level acts. With one, these fields describe it.
const OF_LOW_LEVELS: [&str; 5] =
    ["network.low_level", "network.mlp", "network.lstm", "network.primitives", "network.latent.size"];

impl AlgorithmParameters for Svg0 {
    fn check(&self, rest: &Rest<'_>) -> Result<(), Fault> {
        let Self { discount, target_period, publish_period, lambda, action_samples, entropy, kl, .. } = self;
        ensure("svg0.discount", discount, (0.0..1.0).contains(discount), "must be in [0, 1)")?;
        ensure("svg0.target_period", target_period, *target_period > 0, AT_LEAST_ONE)?;
        ensure("svg0.publish_period", publish_period, *publish_period > 0, AT_LEAST_ONE)?;
        ensure("svg0.lambda", lambda, (0.0..=1.0).contains(lambda), "must be in [0, 1]")?;
        ensure("svg0.action_samples", action_samples, (1..=1024).contains(action_samples), "must be 1 to 1024")?;
        ensure("svg0.entropy", entropy, not_negative(*entropy), NOT_NEGATIVE)?;
        ensure("svg0.kl", kl, not_negative(*kl), NOT_NEGATIVE)?;
        let Self { minibatch_sequences, burn_in, encoder, core, policy, action_value, .. } = self;
        let sequences = *minibatch_sequences;
        ensure("svg0.minibatch_sequences", sequences, (1..=65536).contains(&sequences), "must be 1 to 65536")?;
        let holds = *burn_in < rest.unroll.length;
        ensure("svg0.burn_in", burn_in, holds, "must be less than unroll.length")?;
        layers("svg0.encoder", encoder)?;
        layers("svg0.action_value", action_value)?;
        for (field, units) in [("svg0.core", core), ("svg0.policy", policy)] {
            ensure(field, units, (1..=16384).contains(units), "must be 1 to 16384 units")?;
        }
        ensure("svg0.min_std", self.min_std, (1e-6..=1e3).contains(&self.min_std), "must be 1e-6 to 1000")?;
        let std = self.initial_std;
        ensure("svg0.initial_std", std, std > self.min_std && std <= 1e3, "must exceed svg0.min_std, at most 1000")?;
        rest.replay.check(rest.unroll.length, sequences)
    }

    fn share(&mut self, _: usize) -> Result<(), Fault> {
        ensure("algorithm", "svg0", false, "must be vmpo: the replays of several learners are not shared")
    }

    fn unread(&self, rest: &Rest<'_>) -> Vec<&'static str> {
        let of_low_levels = if rest.transfers { &[][..] } else { &OF_LOW_LEVELS[..] };
        [&UNREAD[..], of_low_levels].concat()
    }

    fn has_low_level(&self) -> bool {
        false
    }

    /// The replay holds older unrolls anyway, and Retrace corrects for the policy that made them.
    fn versions_in(&self, _: u64) -> Option<u64> {
        None
    }

    /// Hidden and cell state of the core's LSTM, then of the policy's.
    fn state_size(&self, _: &Rest<'_>) -> usize {
        2 * (self.core + self.policy)
    }
}
