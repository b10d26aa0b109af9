//! A figure of the service: one JSON line with the medians of rounds in which service and floor take turns.

use std::time::Duration;

use serde_json::{Value, json};

use super::usage::Usage;
use crate::median::median;

/// Bytes.
pub(super) const MEGABYTE: f64 = 1e6;

/// What one round measured.
#[derive(Clone, Copy, Debug)]
pub(super) struct Round {
    megabytes_per_second: f64,
    cpu_seconds_per_gigabyte: f64,
    /// Of resident memory, megabytes.
    growth: f64,
}

impl Round {
    /// `bytes` were carried in the time `took`, between `before` and `after`.
    pub(super) fn new(before: &Usage, after: &Usage, bytes: f64, took: Duration) -> Self {
        Self {
            megabytes_per_second: bytes / MEGABYTE / took.as_secs_f64(),
            cpu_seconds_per_gigabyte: (after.cpu_seconds - before.cpu_seconds) / (bytes / 1e9),
            growth: (after.peak - before.resident) / MEGABYTE,
        }
    }

    /// The same round with its growth counted from `resident` bytes.
    pub(super) fn grown_from(self, resident: f64, after: &Usage) -> Self {
        Self { growth: (after.peak - resident) / MEGABYTE, ..self }
    }

    /// The figure of this round alone, which has no floor.
    pub(super) fn line(&self, figure: &str) -> Value {
        json!({
            "figure": figure, "value": self.megabytes_per_second, "unit": "MB/s",
            "cpu_s_per_gb": self.cpu_seconds_per_gigabyte,
        })
    }
}

/// Prints the figure of `rounds` against `floors`, with the members of `rest` in the same line.
pub(super) fn show(figure: &str, rounds: &[Round], floors: &[Round], rest: Value) {
    let of = |rounds: &[Round], part: fn(&Round) -> f64| median(rounds.iter().map(part).collect());
    let value = of(rounds, |round| round.megabytes_per_second);
    let floor = of(floors, |round| round.megabytes_per_second);
    let line = json!({
        "figure": figure, "value": value, "unit": "MB/s", "floor": floor, "ratio": value / floor,
        "cpu_s_per_gb": of(rounds, |round| round.cpu_seconds_per_gigabyte),
        "floor_cpu_s_per_gb": of(floors, |round| round.cpu_seconds_per_gigabyte),
        "peak_growth_mb": of(rounds, |round| round.growth),
        "floor_peak_growth_mb": of(floors, |round| round.growth),
        "rounds": rounds.len(),
    });
    println!("{}", extended(line, rest));
}

/// The object `line` with the members of `rest`.
pub(super) fn extended(mut line: Value, rest: Value) -> Value {
    if let (Some(line), Value::Object(rest)) = (line.as_object_mut(), rest) {
        line.extend(rest);
    }
    line
}
