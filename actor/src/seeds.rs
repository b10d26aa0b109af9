//! Independent seeds from one.

/// Seed number `index` of the family `seed`: SplitMix64 (Steele, Lea and Flood, 2014), whose outputs for neighbouring
/// inputs are unrelated, so neighbouring actors, threads and environments are too.
pub fn derive(seed: u64, index: u64) -> u64 {
    let mut z = seed.wrapping_add(index.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15));
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

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

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::derive;

    #[test]
    fn neighbouring_seeds_give_disjoint_families() {
        let all: HashSet<u64> =
            (0..100).flat_map(|seed| (0..100).map(move |index| derive(derive(1, seed), index))).collect();
        assert_eq!(all.len(), 10_000);
    }
}
