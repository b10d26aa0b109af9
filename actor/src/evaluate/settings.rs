//! The settings of a rollout.

/// Which starts of a task are rolled out.
#[derive(Clone, Copy, Debug, Default)]
pub enum Starts {
    /// Every start once.
    #[default]
    Every,
    /// So many random starts of each clip.
    Random(usize),
    /// At most so many, always the same: spread evenly over the clips, and within each clip. If there are more clips than
    /// that, one start each of clips that are spread evenly over all.
    Spread(usize),
}

/// Starts, noise and parallel environments of a rollout.
#[derive(Clone, Copy, Debug)]
pub struct RolloutSettings {
    /// Where episodes start.
    pub starts: Starts,
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
        Self { starts: Starts::Every, deterministic: false, noise: 0.0, seed: 1, environments: 16 }
    }
}
