//! The sources of latents.

use comic_experiment::TransferPrior;

/// Latents of the prior of the state.
pub(super) const PRIOR: &str = "p(z | s)";
/// The prior's mean, without noise.
pub(super) const MEAN: &str = "μ(s)";
/// The latent 0.
pub(super) const ZERO: &str = "z = 0";

/// Where the latents of a row come from.
#[derive(Clone, Copy)]
pub(super) struct Source {
    pub(super) name: &'static str,
    pub(super) file: &'static str,
    /// Whether the low level has its learned parameters.
    pub(super) trained: bool,
    pub(super) prior: TransferPrior,
    /// Standard deviation of the policy's action.
    pub(super) std: f32,
}

/// All of them, in the table's order.
pub(super) const SOURCES: [Source; 5] = [
    Source { name: PRIOR, file: "state-prior", trained: true, prior: TransferPrior::State, std: 1.0 },
    Source { name: MEAN, file: "state-mean", trained: true, prior: TransferPrior::State, std: 0.0 },
    Source { name: "N(0, I)", file: "standard-prior", trained: true, prior: TransferPrior::Standard, std: 1.0 },
    Source { name: ZERO, file: "zero", trained: true, prior: TransferPrior::Standard, std: 0.0 },
    Source { name: "untrained, N(0, I)", file: "untrained", trained: false, prior: TransferPrior::Standard, std: 1.0 },
];
