//! How many items enter and leave a table.

use std::ops::RangeInclusive;

use thiserror::Error;

use crate::table::Counts;

/// The unit of all quantities: multiples of 2⁻³². They are integers, so nothing is rounded while a run goes on, and the
/// proof below holds as it stands.
const UNIT: f64 = (1_u64 << 32) as f64;
/// Samples per insert that units can express with an error below one part in a million.
const RATIOS: RangeInclusive<f64> = 0.001..=1e6;
/// The greatest error buffer, units: it stops nothing, and no sum with it overflows.
const UNLIMITED: f64 = 1e30;

/// A rate limiter keeps the ratio of sampled to inserted items of a table. It is Reverb's `SampleToInsertRatio`.
///
/// Inserting is free until `min_size` items were inserted; sampling begins then. From there on the *error* of the
/// ratio,
///
/// > (inserted − min_size) · samples_per_insert − sampled,
///
/// stays in [−error_buffer, error_buffer]: an insert that would raise it above is not allowed, nor is a sample that
/// would lower it below. Items are counted, not calls. The limiter decides and counts; it holds no items, threads or
/// clocks.
///
/// # One side can always move
/// Suppose that neither an insert nor a sample of n items is allowed. Then inserted ≥ min_size, the error is above
/// error_buffer − samples_per_insert, and it is below n − error_buffer. So 2 · error_buffer < samples_per_insert + n.
/// This is impossible, since error_buffer is at least samples_per_insert and at least n. The counts do not matter, so
/// it holds for any counts from a checkpoint too. As min_size is at least n, the table also holds the n different items
/// of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RateLimiter {
    /// In units.
    samples_per_insert: i128,
    min_size: u64,
    /// In units.
    error_buffer: i128,
    counts: Counts,
}

/// A rate limiter that would stop both inserts and samples, or never limit anything.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum RateError {
    /// The ratio is out of range.
    #[error("{samples_per_insert} samples per insert: the number must be at least 0.001 and at most 1000000")]
    Ratio {
        /// Items sampled for each one inserted.
        samples_per_insert: f64,
    },
    /// Sampling would begin before there are enough items for a sample.
    #[error("a sample has {sample_size} items, but sampling begins with {min_size}: increase the minimum size")]
    MinSize {
        /// Items at which sampling begins.
        min_size: u64,
        /// Items of a sample.
        sample_size: u64,
    },
    /// Neither side could move.
    #[error(
        "an error buffer of {error_buffer} items could stop both inserts and samples: increase it to at least {least}, \
         the larger one of samples per insert and the items of a sample"
    )]
    ErrorBuffer {
        /// The greatest error of the ratio, items.
        error_buffer: f64,
        /// The least error buffer that is allowed, items.
        least: f64,
    },
}

impl RateLimiter {
    /// A limiter for `samples_per_insert` sampled items per inserted item. Sampling begins with `min_size` items, which
    /// should be at most the table's `max_size`. `error_buffer` is the greatest error of the ratio, in items. At most
    /// `sample_size` items are sampled at once.
    ///
    /// # Errors
    /// [`RateError`], if it would not limit, or could stop both inserts and samples.
    pub fn new(samples_per_insert: f64, min_size: u64, error_buffer: f64, sample_size: u64) -> Result<Self, RateError> {
        if !RATIOS.contains(&samples_per_insert) {
            return Err(RateError::Ratio { samples_per_insert });
        }
        if min_size < sample_size.max(1) {
            return Err(RateError::MinSize { min_size, sample_size });
        }
        // NaN becomes 0.
        let units = |value: f64| (value * UNIT).round().clamp(-UNLIMITED, UNLIMITED) as i128;
        let limiter = Self {
            samples_per_insert: units(samples_per_insert),
            min_size,
            error_buffer: units(error_buffer),
            counts: Counts::default(),
        };
        if limiter.error_buffer < limiter.samples_per_insert.max(items(sample_size.max(1))) {
            return Err(RateError::ErrorBuffer {
                error_buffer,
                least: samples_per_insert.max(sample_size.max(1) as f64),
            });
        }
        Ok(limiter)
    }

    /// The same limiter with the counts of a checkpoint. They are those of the table that it limits.
    #[must_use]
    pub fn with_counts(self, counts: Counts) -> Self {
        Self { counts, ..self }
    }

    /// Items inserted and sampled since the beginning: its whole state.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// How many items may be inserted now.
    pub fn insertable(&self) -> usize {
        let free = self.min_size.saturating_sub(self.counts.inserted);
        let limited = (self.error_buffer - self.error()).div_euclid(self.samples_per_insert);
        usize::try_from(limited.max(free.into())).unwrap_or(usize::MAX)
    }

    /// Whether `n` items may be sampled now.
    pub fn can_sample(&self, n: usize) -> bool {
        self.counts.inserted >= self.min_size && self.error() - items(n as u64) >= -self.error_buffer
    }

    /// Whether the error of the ratio is within the error buffer, as it is wherever the limiter was obeyed.
    pub fn is_within(&self) -> bool {
        let begins = self.counts.inserted < self.min_size && self.counts.sampled == 0;
        begins || self.error().abs() <= self.error_buffer
    }

    /// The same limiter with as many samples counted as make the error 0, or none if there are too few items: for counts that
    /// another limiter kept.
    #[must_use]
    pub fn balanced(self) -> Self {
        let inserted = i128::from(self.counts.inserted.saturating_sub(self.min_size));
        let sampled = u64::try_from((inserted * self.samples_per_insert) >> 32).unwrap_or(u64::MAX);
        self.with_counts(Counts { sampled, ..self.counts })
    }

    /// Counts inserted items.
    pub fn did_insert(&mut self, n: usize) {
        self.counts.inserted = self.counts.inserted.saturating_add(n as u64);
    }

    /// Counts sampled items.
    pub fn did_sample(&mut self, n: usize) {
        self.counts.sampled = self.counts.sampled.saturating_add(n as u64);
    }

    /// The error of the ratio, in units.
    fn error(&self) -> i128 {
        let inserted = i128::from(self.counts.inserted) - i128::from(self.min_size);
        inserted * self.samples_per_insert - items(self.counts.sampled)
    }
}

/// So many items in units.
fn items(n: u64) -> i128 {
    i128::from(n) << 32
}
