//! Progress of a long step: a bar on a terminal, a line every few seconds elsewhere.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

/// Time between two lines where there is no terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(10);

/// Whether standard error is a terminal.
pub fn on_terminal() -> bool {
    std::io::stderr().is_terminal()
}

/// Progress of one step, counted in bytes.
pub(crate) struct Progress {
    label: String,
    total: u64,
    bar: Option<ProgressBar>,
    last_line: Instant,
}

impl Progress {
    /// Starts a step of `total` bytes.
    pub(crate) fn start(label: impl Into<String>, total: u64) -> Self {
        let label = label.into();
        let bar = on_terminal().then(|| {
            let bar = ProgressBar::new(total);
            if let Ok(style) =
                ProgressStyle::with_template("{msg:46} {bar:24} {bytes:>11} / {total_bytes:11} {bytes_per_sec:>13}")
            {
                bar.set_style(style);
            }
            bar.set_message(label.clone());
            bar
        });
        if bar.is_none() {
            eprintln!("{label} ({})", mebibytes(total));
        }
        Self { label, total, bar, last_line: Instant::now() }
    }

    /// Shows that `position` of the total bytes are done.
    pub(crate) fn set(&mut self, position: u64) {
        let position = position.min(self.total);
        if let Some(bar) = &self.bar {
            bar.set_position(position);
        } else if self.last_line.elapsed() >= LINE_INTERVAL {
            self.last_line = Instant::now();
            eprintln!("{}: {} %", self.label, 100 * position / self.total.max(1));
        }
    }

    /// The step is done.
    pub(crate) fn finish(self) {
        if let Some(bar) = self.bar {
            bar.set_position(self.total);
            bar.finish();
        }
    }
}

/// `bytes` as text, in MiB.
pub(crate) fn mebibytes(bytes: u64) -> String {
    let mebibyte = 1u64 << 20;
    format!("{:.1} MiB", bytes as f64 / mebibyte as f64)
}
