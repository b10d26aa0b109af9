//! Independent seeds from one seed.

/// Output number `index` (from 0) of the generator SplitMix64 that starts at `seed`.
///
/// Outputs of neighbouring indices and of neighbouring seeds are unrelated, so neighbouring actors, threads and
/// environments get independent random numbers. The same arguments give the same seed on every machine.
///
/// Source of the constants: Steele, Lea and Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014, with
/// Stafford's mix 13, as in Java's `SplittableRandom`.
#[must_use]
pub fn derive(seed: u64, index: u64) -> u64 {
    let mut z = seed.wrapping_add(index.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::derive;

    /// The first outputs of Vigna's reference implementation (`splitmix64.c`).
    #[test]
    fn outputs_equal_the_reference_implementation() {
        assert_eq!(
            [0, 1, 2].map(|index| derive(1_234_567, index)),
            [6_457_827_717_110_365_317, 3_203_168_211_198_807_973, 9_817_491_932_198_370_423]
        );
    }

    #[test]
    fn neighbouring_seeds_give_disjoint_families() {
        let all: HashSet<u64> =
            (0..100).flat_map(|seed| (0..100).map(move |index| derive(derive(1, seed), index))).collect();
        assert_eq!(all.len(), 10_000);
    }
}
