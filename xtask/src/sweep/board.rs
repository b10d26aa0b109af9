//! Progress of a sweep on a terminal: a bar, and a row for each run. Elsewhere each run prints its own lines.

use std::time::Duration;

use comic_setup::on_terminal;
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

use super::plan::Run;
use crate::train::display::Display;

pub(super) struct Board(Option<Bars>);

struct Bars {
    rows: MultiProgress,
    runs: ProgressBar,
}

impl Board {
    /// For `total` runs, of which `finished` are finished.
    pub(super) fn new(total: usize, finished: usize) -> Self {
        Self(on_terminal().then(|| {
            let rows = MultiProgress::new();
            let runs = rows.add(ProgressBar::new(total as u64).with_position(finished as u64));
            if let Ok(style) = ProgressStyle::with_template("{elapsed_precise} {wide_bar} {pos} of {len} runs") {
                runs.set_style(style);
            }
            runs.enable_steady_tick(Duration::from_millis(500));
            Bars { rows, runs }
        }))
    }

    /// The display of `run`.
    pub(super) fn display(&self, run: &Run) -> Display {
        let row = self.0.as_ref().map(|bars| bars.rows.insert_before(&bars.runs, ProgressBar::new(0)));
        Display::beside_others(&run.name, &run.job.experiment().budget, row)
    }

    /// Counts one more finished run.
    pub(super) fn count(&self) {
        if let Some(bars) = &self.0 {
            bars.runs.inc(1);
        }
    }

    /// Leaves the bar as it is.
    pub(super) fn finish(&self) {
        if let Some(bars) = &self.0 {
            bars.runs.abandon();
        }
    }
}
