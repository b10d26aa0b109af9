//! One line of output, and the medians behind it.

use std::borrow::Cow;
use std::io::Write as _;
use std::time::{Duration, Instant};

use comic_experiment::{LowLevelName, statistics::median};
use serde::Serialize;

use crate::Error;

/// Segments below which a median means little.
const FEWEST_SEGMENTS: usize = 5;

#[derive(Clone, Debug, Serialize)]
pub(super) struct Figure {
    figure: Cow<'static, str>,
    value: f64,
    unit: &'static str,
    floor: f64,
    ratio: f64,
    #[serde(skip_serializing_if = "str::is_empty")]
    note: &'static str,
}

impl Figure {
    pub(super) fn new(
        figure: &'static str,
        unit: &'static str,
        Medians { value, floor }: Medians,
        note: &'static str,
    ) -> Self {
        Self { figure: Cow::Borrowed(figure), value, unit, floor, ratio: value / floor, note }
    }

    /// Of a policy with this low level: the MLP's figures bear no name.
    pub(super) fn of(mut self, low_level: LowLevelName) -> Self {
        if low_level != LowLevelName::Mlp {
            self.figure = format!("{}.{low_level}", self.figure).into();
        }
        self
    }

    pub(super) fn print(&self) -> Result<(), Error> {
        let line = serde_json::to_string(self)
            .map_err(|error| Error::Usage(format!("cannot write a figure as JSON: {error}")))?;
        writeln!(std::io::stdout(), "{line}").map_err(Error::file("standard output"))
    }
}

/// Of value and floor, each the median of its own segments.
#[derive(Clone, Copy, Debug)]
pub(super) struct Medians {
    pub(super) value: f64,
    pub(super) floor: f64,
}

/// Repeats a pair of segments (value, floor) for as long as the budget lasts; the first pair warms up and is dropped.
pub(super) fn interleave<E>(budget: Duration, mut pair: impl FnMut() -> Result<(f64, f64), E>) -> Result<Medians, E> {
    pair()?;
    let begin = Instant::now();
    let (mut values, mut floors) = (Vec::new(), Vec::new());
    while values.len() < FEWEST_SEGMENTS || begin.elapsed() < budget {
        let (value, floor) = pair()?;
        values.push(value);
        floors.push(floor);
    }
    let of = |values| median(values).unwrap_or(f64::NAN);
    Ok(Medians { value: of(values), floor: of(floors) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_forget_the_warm_up_and_the_outliers() {
        let mut calls = 0.0;
        let medians = interleave::<()>(Duration::ZERO, || {
            calls += 1.0;
            Ok(if calls == 1.0 || calls == 4.0 { (1e9, -1e9) } else { (calls, calls / 2.0) })
        });
        let Medians { value, floor } = medians.unwrap();
        assert_eq!((value, floor), (5.0, 1.5));
    }
}
