//! The seeds of an environment.

use comic_experiment::seed::derive;

/// The seeds of one environment. They do not depend on the actor, the thread, or the other environments.
#[derive(Clone, Copy, Debug)]
pub struct EnvironmentSeeds {
    /// Of its episodes and simulation.
    pub simulation: u64,
    /// Of the noise of its latents and actions.
    pub noise: u64,
}

impl EnvironmentSeeds {
    /// The seeds of environment `number`, derived from `seed`.
    pub fn new(seed: u64, number: u32) -> Self {
        let own = derive(seed, u64::from(number));
        Self { simulation: derive(own, 0), noise: derive(own, 1) }
    }
}
