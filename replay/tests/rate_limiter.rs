//! The rate limiter is Reverb's: it keeps the ratio within the error buffer, and one side can always move.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use comic_replay::{Counts, RateError, RateLimiter};
use proptest::prelude::*;

/// The sizes of a limiter. Numbers are multiples of 1/8, so sums of f64 are exact.
#[derive(Clone, Copy, Debug)]
struct Sizes {
    samples_per_insert: f64,
    min_size: u64,
    error_buffer: f64,
    sample_size: u64,
}

impl Sizes {
    fn limiter(self) -> RateLimiter {
        RateLimiter::new(self.samples_per_insert, self.min_size, self.error_buffer, self.sample_size).unwrap()
    }

    /// (inserted − min_size) · samples_per_insert − sampled.
    fn error(self, counts: Counts) -> f64 {
        (counts.inserted as f64 - self.min_size as f64) * self.samples_per_insert - counts.sampled as f64
    }

    /// Reverb's `RateLimiter::CanInsert` for one item, with `SampleToInsertRatio`'s `max_diff`. No item was deleted
    /// before the table has its minimum size.
    fn reverb_inserts(self, counts: Counts) -> bool {
        let max_diff = self.min_size as f64 * self.samples_per_insert + self.error_buffer;
        let diff = (counts.inserted + 1) as f64 * self.samples_per_insert - counts.sampled as f64;
        counts.inserted < self.min_size || diff <= max_diff
    }

    /// Reverb's `RateLimiter::CanSample`, with `SampleToInsertRatio`'s `min_diff`.
    fn reverb_samples(self, counts: Counts, n: u64) -> bool {
        let min_diff = self.min_size as f64 * self.samples_per_insert - self.error_buffer;
        let diff = counts.inserted as f64 * self.samples_per_insert - (counts.sampled + n) as f64;
        counts.inserted >= self.min_size && diff >= min_diff
    }
}

fn sizes() -> impl Strategy<Value = Sizes> {
    (1_u32..200, 1_u64..20, 0_u64..30, prop_oneof![Just(0_u32), 0_u32..300]).prop_map(
        |(ratio, sample_size, more, slack)| {
            let samples_per_insert = f64::from(ratio) / 8.0;
            let error_buffer = samples_per_insert.max(sample_size as f64) + f64::from(slack) / 8.0;
            Sizes { samples_per_insert, min_size: sample_size + more, error_buffer, sample_size }
        },
    )
}

fn counts() -> impl Strategy<Value = Counts> {
    let count = || prop_oneof![0_u64..200, any::<u64>()];
    (count(), count()).prop_map(|(inserted, sampled)| Counts { inserted, sampled })
}

proptest! {
    #[test]
    fn it_decides_as_reverb_does(sizes in sizes(), inserted in 0_u64..200, sampled in 0_u64..2000, n in 1_u64..20) {
        let counts = Counts { inserted, sampled };
        let limiter = sizes.limiter().with_counts(counts);
        prop_assert_eq!(limiter.insertable() > 0, sizes.reverb_inserts(counts));
        prop_assert_eq!(limiter.can_sample(n as usize), sizes.reverb_samples(counts, n));
    }

    #[test]
    fn it_allows_as_many_inserts_as_are_allowed_one_after_another(
        sizes in sizes(), inserted in 0_u64..200, sampled in 0_u64..2000,
    ) {
        let limiter = sizes.limiter().with_counts(Counts { inserted, sampled });
        let mut counts = limiter.counts();
        while sizes.reverb_inserts(counts) {
            counts.inserted += 1;
        }
        prop_assert_eq!(limiter.insertable() as u64, counts.inserted - inserted);
    }

    /// Inserts and samples of any size are tried in any order.
    #[test]
    fn the_ratio_stays_within_the_error_buffer(
        sizes in sizes(), attempts in prop::collection::vec((any::<bool>(), 1_u64..20), 1..500),
    ) {
        let mut limiter = sizes.limiter();
        for (is_insert, n) in attempts {
            if is_insert {
                limiter.did_insert(limiter.insertable().min(n as usize));
            } else if limiter.can_sample(n.min(sizes.sample_size) as usize) {
                limiter.did_sample(n.min(sizes.sample_size) as usize);
            }
            let counts = limiter.counts();
            if counts.inserted < sizes.min_size {
                prop_assert_eq!(counts.sampled, 0, "sampling began too early");
            } else {
                prop_assert!(sizes.error(counts).abs() <= sizes.error_buffer, "{:?}", counts);
            }
        }
    }

    #[test]
    fn one_side_can_move_in_every_state(sizes in sizes(), counts in counts()) {
        let limiter = sizes.limiter().with_counts(counts);
        for n in 1..=sizes.sample_size {
            prop_assert!(limiter.insertable() > 0 || limiter.can_sample(n as usize), "{:?}", limiter);
        }
    }

    #[test]
    fn a_restored_limiter_continues(sizes in sizes(), counts in counts()) {
        let before = sizes.limiter().with_counts(counts);
        let stored = serde_json::to_string(&before.counts()).unwrap();
        prop_assert_eq!(sizes.limiter().with_counts(serde_json::from_str(&stored).unwrap()), before);
    }

    /// Whatever the numbers are, a limiter that is not refused stops at most one side.
    #[test]
    fn a_limiter_that_could_stop_both_sides_is_refused(
        ratio in prop_oneof![any::<f64>(), 0.0..100.0], min_size in prop_oneof![any::<u64>(), 0..100_u64],
        buffer in prop_oneof![any::<f64>(), 0.0..200.0], sample_size in prop_oneof![any::<u32>(), 0..100_u32],
        counts in counts(),
    ) {
        if let Ok(limiter) = RateLimiter::new(ratio, min_size, buffer, sample_size.into()) {
            let limiter = limiter.with_counts(counts);
            prop_assert!(limiter.insertable() > 0 || limiter.can_sample(sample_size as usize), "{:?}", limiter);
        }
    }
}

#[test]
fn a_learner_that_samples_whenever_it_may_reaches_the_ratio() {
    let mut limiter = RateLimiter::new(2.5, 40, 32.0, 32).unwrap();
    for _ in 0..1000 {
        while limiter.can_sample(32) {
            limiter.did_sample(32);
        }
        limiter.did_insert(limiter.insertable().min(3));
    }
    let Counts { inserted, sampled } = limiter.counts();
    assert!((sampled as f64 - 2.5 * (inserted - 40) as f64).abs() <= 32.0, "{sampled} of {inserted}");
    assert_eq!(inserted, 3000, "inserts never waited");
}

#[test]
fn the_refusals_name_the_remedy() {
    let refusal = |ratio, min_size, buffer| RateLimiter::new(ratio, min_size, buffer, 8).unwrap_err();
    assert_eq!(refusal(4.0, 8, 7.9), RateError::ErrorBuffer { error_buffer: 7.9, least: 8.0 });
    assert_eq!(refusal(16.0, 8, 8.0), RateError::ErrorBuffer { error_buffer: 8.0, least: 16.0 });
    assert!(matches!(refusal(1.0, 8, f64::NAN), RateError::ErrorBuffer { .. }));
    assert!(matches!(refusal(1.0, 8, f64::NEG_INFINITY), RateError::ErrorBuffer { .. }));
    assert_eq!(refusal(4.0, 7, 8.0), RateError::MinSize { min_size: 7, sample_size: 8 });
    for ratio in [0.0, -1.0, f64::INFINITY, 2e6] {
        assert_eq!(refusal(ratio, 8, 8.0), RateError::Ratio { samples_per_insert: ratio });
    }
    let text = refusal(16.0, 8, 8.0).to_string();
    assert!(text.contains("increase it to at least 16"), "{text}");
    let unlimited = RateLimiter::new(1.0, 8, f64::INFINITY, 8).unwrap();
    assert!(
        unlimited.with_counts(Counts { inserted: 8, sampled: 1 << 60 }).can_sample(8),
        "only the minimum size counts"
    );
}
