//! `comic-actor clips speed`.

use std::path::PathBuf;

use clap::Args;
use comic_clips::edit::{rewrite, speed};
use comic_experiment::ClipSource;

use super::print;
use crate::Error;

/// Writes every clip at other speeds. CLIP at 0.8 times its speed becomes CLIP_x80.
///
/// Frames stay 0.03 s apart. Gravity does not change: jumps and runs are possible only near their own speed.
#[derive(Args, Clone, Debug)]
pub(super) struct Speed {
    /// The clips: FILE.h5, FILE.h5#SUBSET, FILE.h5#CLIP,CLIP or builtin:NAME.
    #[arg(value_name = "SOURCE", required = true)]
    sources: Vec<String>,
    /// The speed relative to the recording, 0.5 to 2 with at most two decimals; several with commas between them.
    #[arg(long, value_name = "FACTOR", required = true, value_delimiter = ',')]
    factor: Vec<f64>,
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

impl Speed {
    pub(super) fn run(&self) -> Result<(), Error> {
        self.check_factors()?;
        let sources: Vec<ClipSource> = self.sources.iter().map(|source| ClipSource::parse(source)).collect();
        let mut told = String::new();
        let clips = rewrite(&sources, &self.out, self.force, self.with_originals, |clip, writer| {
            for factor in &self.factor {
                let other = speed(clip, *factor)?;
                let seconds = other.dt * other.steps() as f64;
                told += &format!("{}: {} frames become {}, {seconds:.2} s\n", other.name, clip.steps(), other.steps());
                writer.add(&other)?;
            }
            Ok(())
        })?;
        print(&format!("{told}{clips} clips in {}\n", self.out.display()))
    }

    /// Refuses a repeated factor: its clips would have the names of the first one's.
    fn check_factors(&self) -> Result<(), Error> {
        // Factors that are whole per cents differ by more.
        const SAME: f64 = 1e-6;
        for (index, factor) in self.factor.iter().enumerate() {
            if self.factor.iter().take(index).any(|other| (factor - other).abs() < SAME) {
                return Err(Error::Usage(format!("--factor {factor}: is there twice; give each factor once")));
            }
        }
        Ok(())
    }
}
