//! The seeds of an environment.

use comic_experiment::seed::derive;

/// What is random about one environment, whoever simulates it and beside which others.
#[derive(Clone, Copy, Debug)]
pub struct EnvironmentSeeds {
    /// Of its episodes.
    pub simulation: u64,
    /// Of its latents' and its actions' noise.
    pub noise: u64,
}

impl EnvironmentSeeds {
    /// Of environment `number` of the family `seed`.
    pub fn new(seed: u64, number: u32) -> Self {
        let own = derive(seed, u64::from(number));
        Self { simulation: derive(own, 0), noise: derive(own, 1) }
    }
}
