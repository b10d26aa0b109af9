//! `comic-actor clips mirror`.

use std::path::PathBuf;

use clap::Args;
use comic_clips::edit::{Fit, mirror, rewrite};
use comic_experiment::ClipSource;

use super::print;
use crate::Error;

/// Writes the mirror image of every clip: left and right exchanged. CLIP becomes CLIP_mirror.
///
/// The body's right arm cannot hang as its left arm can. Where an arm is outside its ranges, elbow and wrist are put as
/// near to their places as they get.
#[derive(Args, Clone, Debug)]
pub(super) struct Mirror {
    /// The clips to mirror: FILE.h5, FILE.h5#SUBSET, FILE.h5#CLIP,CLIP or builtin:NAME.
    #[arg(value_name = "SOURCE", required = true)]
    sources: Vec<String>,
    /// The new file.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Replace the file if it is there.
    #[arg(long)]
    force: bool,
    /// Write the clips themselves as well.
    #[arg(long)]
    with_originals: bool,
}

impl Mirror {
    pub(super) fn run(&self) -> Result<(), Error> {
        let sources: Vec<ClipSource> = self.sources.iter().map(|source| ClipSource::parse(source)).collect();
        let mut told = String::new();
        let clips = rewrite(&sources, &self.out, self.force, self.with_originals, |clip, writer| {
            let (mirrored, fit) = mirror(clip)?;
            told += &format!("{}: {} frames, {}\n", mirrored.name, mirrored.steps(), in_words(&fit));
            writer.add(&mirrored)
        })?;
        print(&format!("{told}{clips} clips in {}\n", self.out.display()))
    }
}

fn in_words(fit: &Fit) -> String {
    if fit.frames == 0 {
        return "every angle in its range".into();
    }
    format!(
        "{} with an arm outside its ranges: angles changed by {:.2}° on average and {:.0}° at most, wrists {:.1} cm on average",
        fit.frames,
        fit.mean_degrees,
        fit.worst_degrees,
        100.0 * fit.wrists
    )
}
