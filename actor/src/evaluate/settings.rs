//! The settings of a rollout.

/// Starts, noise and parallel environments of a rollout.
#[derive(Clone, Copy, Debug)]
pub struct RolloutSettings {
    /// Episodes of each clip from random starts; every start once when absent.
    pub episodes: Option<usize>,
    /// The mean action and the latent's mean instead of samples.
    pub deterministic: bool,
    /// Standard deviation of Gaussian noise that is added to each entry of a mean action, before clipping.
    pub noise: f32,
    /// Seed of random starts and of the noise.
    pub seed: u64,
    /// Environments in one forward pass.
    pub environments: usize,
}

impl Default for RolloutSettings {
    fn default() -> Self {
        Self { episodes: None, deterministic: false, noise: 0.0, seed: 1, environments: 16 }
    }
}
