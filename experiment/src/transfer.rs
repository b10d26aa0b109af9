//! Transfer: a low level that was learned before acts, frozen, and a new policy gives it latents.

use serde::{Deserialize, Serialize};

/// A frozen low level for the experiment's task (CoMic supplement 2.5). Numbers marked (N) are said nowhere; `latent_limit`
/// is that of MoCapAct.
///
/// The policy's action is then the latent z, and the frozen low level's mean acts on the body. The fields
/// `network.low_level`, `network.latent.size` and the sizes of that low level are those of the file, whatever the document
/// says. The file's own normaliser is frozen, too.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Transfer {
    /// `builtin`, which is the low level in the programs; a file that `comic-learner export --part low-level` wrote; or a run's
    /// directory, whose newest checkpoint is used. Empty is no transfer: the low level is learned.
    pub low_level: String,
    /// SHA-256 of the low level, hexadecimal. The learner fills it in; if it stands here, another low level is refused.
    pub sha256: String,
    /// Each entry of z is clamped to ± this limit before the low level reads it (N).
    pub latent_limit: f64,
    /// The policy's mean is this number times a tanh. 0 is 3 for latents, and 1 for deviations from the prior of the state (N).
    /// Without a frozen low level only SVG(0) bounds its mean so, where 0 is 1: a command lies within ±1.
    pub mean_scale: f64,
    /// What an action of the policy means.
    pub prior: TransferPrior,
}

/// What an action u of a transfer's policy means.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TransferPrior {
    /// The latent itself, whose prior is N(0, I): z = u.
    Standard,
    /// A deviation from the latents that are likely in the pose: z = μ(s) + σ(s) · u, with the prior p(z | s) in the file of the
    /// low level (PULSE; `comic-learner prior` fits it).
    State,
}

impl Default for Transfer {
    fn default() -> Self {
        Self {
            low_level: String::new(),
            sha256: String::new(),
            latent_limit: 3.0,
            mean_scale: 0.0,
            prior: TransferPrior::Standard,
        }
    }
}

impl Transfer {
    /// The name of the low level that is compiled into the programs. There is one, so it has no other name.
    pub const BUILTIN: &'static str = "builtin";

    /// Whether the experiment uses a frozen low level.
    pub fn is_on(&self) -> bool {
        !self.low_level.is_empty()
    }

    /// What the tanh of the policy's mean is multiplied by.
    pub fn mean_scale(&self) -> f64 {
        match (self.mean_scale > 0.0, self.is_on(), self.prior) {
            (true, _, _) => self.mean_scale,
            (false, true, TransferPrior::Standard) => 3.0,
            (false, true, TransferPrior::State) | (false, false, _) => 1.0,
        }
    }
}
