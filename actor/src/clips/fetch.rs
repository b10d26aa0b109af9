//! `comic-actor clips fetch`.

use std::io::IsTerminal as _;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::{Expected, download, print};
use crate::Error;

/// DeepMind's CMU clips, fitted to the V2020 body: URL, size and hash are those of dm_control 1.0.49,
/// `locomotion/mocap/cmu_mocap_data.py`.
const URL: &str = "https://storage.googleapis.com/dm_control/cmu_2020_dfe3e9e0.h5";
const PUBLISHED: Expected =
    Expected { size: 476_559_420, sha256: "dfe3e9e0b08d32960bdafbf89e541339ca8908a9a5e7f4a2c986362890d72863" };
/// Time between two log lines, when there is no terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(10);

/// Fetches DeepMind's clips of 2020 (836 of the CMU database, 455 MiB) and verifies size and SHA-256.
///
/// An interrupted download is continued. A complete file is not fetched again.
#[derive(Args, Clone, Debug)]
pub(super) struct Fetch {
    /// The URL of the file, or of a mirror with the same file.
    #[arg(long, value_name = "URL", default_value = URL)]
    url: String,
    /// The new file.
    #[arg(long, value_name = "FILE", default_value = "cmu_2020_dfe3e9e0.h5")]
    out: PathBuf,
    /// Replace another file of that name.
    #[arg(long)]
    force: bool,
}

impl Fetch {
    pub(super) fn run(&self) -> Result<(), Error> {
        let mut progress = Progress::start(PUBLISHED.size);
        let fetched = download(&self.url, &self.out, &PUBLISHED, self.force, &mut |there| progress.set(there))?;
        progress.finish();
        let what = if fetched { "fetched and verified" } else { "there already, and verified" };
        print(&format!("{}: {what}; see `comic-actor clips list`\n", self.out.display()))
    }
}

/// A progress bar on a terminal, log lines elsewhere.
struct Progress {
    total: u64,
    bar: Option<ProgressBar>,
    last_line: Instant,
}

impl Progress {
    fn start(total: u64) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(total);
            if let Ok(style) =
                ProgressStyle::with_template("{bar:32} {bytes:>11} / {total_bytes} {bytes_per_sec:>13} {eta:>4}")
            {
                bar.set_style(style);
            }
            bar
        });
        Self { total, bar, last_line: Instant::now() }
    }

    fn set(&mut self, there: u64) {
        if let Some(bar) = &self.bar {
            bar.set_position(there);
        } else if self.last_line.elapsed() >= LINE_INTERVAL {
            self.last_line = Instant::now();
            tracing::info!(bytes = there, of = self.total, percent = 100 * there / self.total, "fetching");
        }
    }

    fn finish(self) {
        if let Some(bar) = self.bar {
            bar.finish_and_clear();
        }
    }
}
