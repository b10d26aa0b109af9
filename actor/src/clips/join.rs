//! `comic-actor clips join`.

use std::path::PathBuf;

use clap::Args;
use comic_clips::edit::{Balance, join, rewrite};
use comic_clips::{Catalogue, Clip};
use comic_experiment::ClipSource;

use super::print;
use crate::Error;

/// Writes clips with the root and the legs of one clip and the thorax, head and arms of another. The name is
/// LEGS_join_UPPER, the length that of the shorter clip.
///
/// The back leans so that the centre of mass is horizontally where it is in the clip of the legs. Whether arms touch the
/// body is not checked.
#[derive(Args, Clone, Debug)]
pub(super) struct Join {
    /// Whose legs: FILE.h5, FILE.h5#SUBSET, FILE.h5#CLIP,CLIP or builtin:NAME.
    #[arg(long, value_name = "SOURCE")]
    legs: String,
    /// Whose upper body. Each of these clips is joined with each clip of --legs.
    #[arg(long, value_name = "SOURCE")]
    upper: String,
    /// The new file.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Replace the file if it is there.
    #[arg(long)]
    force: bool,
}

impl Join {
    pub(super) fn run(&self) -> Result<(), Error> {
        let [legs, upper] = [&self.legs, &self.upper].map(|source| [ClipSource::parse(source)]);
        let upper = Catalogue::open(&upper)?;
        let mut told = String::new();
        let clips = rewrite(&legs, &self.out, self.force, false, |legs, writer| {
            for index in 0..upper.entries().len() {
                let (joined, balance) = join(legs, &upper.load(index)?)?;
                told += &line(&joined, &balance);
                writer.add(&joined)?;
            }
            Ok(())
        })?;
        print(&format!("{told}{clips} clips in {}\n", self.out.display()))
    }
}

fn line(clip: &Clip, balance: &Balance) -> String {
    let [[before, _], [after, most]] = [balance.before, balance.after].map(|pair| pair.map(|meters| 1000.0 * meters));
    format!(
        "{}: {} frames, centre of mass {before:.1} mm beside that of the legs' clip, {after:.1} mm with the trunk leaned ({most:.1} mm \
         at most), back up to {:.1}°, lowest point {:.1} mm\n",
        clip.name,
        clip.steps(),
        balance.lean_degrees,
        1000.0 * balance.lowest
    )
}
