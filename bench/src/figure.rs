//! One line of output, and the medians in it.

use std::borrow::Cow;
use std::io::Write as _;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};
use comic_experiment::LowLevelName;
use serde::Serialize;

use crate::median::median;

/// The smallest number of segments of a median.
const FEWEST_SEGMENTS: usize = 5;

#[derive(Clone, Debug, Serialize)]
pub(crate) struct Figure {
    figure: Cow<'static, str>,
    value: f64,
    unit: &'static str,
    floor: f64,
    ratio: f64,
    #[serde(skip_serializing_if = "str::is_empty")]
    note: &'static str,
}

impl Figure {
    pub(crate) fn new(
        figure: &'static str,
        unit: &'static str,
        Medians { value, floor }: Medians,
        note: &'static str,
    ) -> Self {
        Self { figure: Cow::Borrowed(figure), value, unit, floor, ratio: value / floor, note }
    }

    /// Adds the name of the policy's low level, unless it is the MLP.
    pub(crate) fn named_after(mut self, low_level: LowLevelName) -> Self {
        if low_level != LowLevelName::Mlp {
            self.figure = format!("{}.{low_level}", self.figure).into();
        }
        self
    }

    pub(crate) fn print(&self) -> Result<()> {
        let line = serde_json::to_string(self)?;
        writeln!(std::io::stdout(), "{line}").context("cannot write to standard output")
    }
}

/// The median of the value's segments and that of the floor's.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Medians {
    pub(crate) value: f64,
    pub(crate) floor: f64,
}

/// Repeats a pair of segments (value, floor) until the budget is used up. The first pair warms up and is not counted.
pub(crate) fn interleave<E>(budget: Duration, mut pair: impl FnMut() -> Result<(f64, f64), E>) -> Result<Medians, E> {
    pair()?;
    let begin = Instant::now();
    let (mut values, mut floors) = (Vec::new(), Vec::new());
    while values.len() < FEWEST_SEGMENTS || begin.elapsed() < budget {
        let (value, floor) = pair()?;
        values.push(value);
        floors.push(floor);
    }
    Ok(Medians { value: median(values), floor: median(floors) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_leave_out_the_warm_up_and_the_outliers() {
        let mut calls = 0.0;
        let medians = interleave::<()>(Duration::ZERO, || {
            calls += 1.0;
            Ok(if calls == 1.0 || calls == 4.0 { (1e9, -1e9) } else { (calls, calls / 2.0) })
        });
        let Medians { value, floor } = medians.unwrap();
        assert_eq!((value, floor), (5.0, 1.5));
    }
}
