//! `comic-actor clips merge`.

use std::path::PathBuf;

use clap::Args;
use comic_experiment::ClipSource;

use super::print;
use crate::Error;

/// Writes the clips of several sources into one file, which dm_control can read too. The file has poses, velocities and
/// features. Markers, props, dates and body masses are left out, since no task reads them.
#[derive(Args, Clone, Debug)]
pub(super) struct Merge {
    /// The clips to merge: FILE.h5, FILE.h5#SUBSET, FILE.h5#CLIP,CLIP or builtin:NAME.
    #[arg(value_name = "SOURCE", required = true)]
    sources: Vec<String>,
    /// The new file.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Replace the file if it is there.
    #[arg(long)]
    force: bool,
}

impl Merge {
    pub(super) fn run(&self) -> Result<(), Error> {
        let sources: Vec<ClipSource> = self.sources.iter().map(|source| ClipSource::parse(source)).collect();
        let clips = comic_clips::merge(&sources, &self.out, self.force, |done, all| {
            if done.is_multiple_of(100) && done < all {
                tracing::info!(done, all, "clips");
            }
        })?;
        print(&format!("{clips} clips in {}\n", self.out.display()))
    }
}
