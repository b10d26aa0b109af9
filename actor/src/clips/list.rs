//! `comic-actor clips list`.

use clap::Args;
use comic_clips::{Catalogue, Entry, subsets_with};
use comic_experiment::{ClipSource, Tracking};
use serde::Serialize;

use super::{print, print_json, table::table};
use crate::Error;

/// Lists clips: name, frames, seconds, the possible start frames, and the subsets of dm_control that contain the clip;
/// for a copy, what it was made from.
///
/// Starts follow from the tracking task's defaults. The last frames are no starts, since no reference frames follow
/// them.
#[derive(Args, Clone, Debug)]
pub(super) struct List {
    /// The clips to list: FILE.h5, FILE.h5#SUBSET, FILE.h5#CLIP,CLIP or builtin:NAME.
    #[arg(value_name = "FILE", required = true)]
    sources: Vec<String>,
    /// One JSON array: clip, frames, seconds, dt, model, subsets, starts ([first, end), or null when there are none),
    /// made_from (null, or for a clip made of others how, for instance "mirror CMU_007_01").
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Listed<'a> {
    clip: &'a str,
    frames: usize,
    seconds: f64,
    dt: f64,
    model: String,
    subsets: Vec<&'static str>,
    starts: Option<[usize; 2]>,
    made_from: Option<&'a str>,
}

impl List {
    pub(super) fn run(&self) -> Result<(), Error> {
        let sources: Vec<ClipSource> = self.sources.iter().map(|source| ClipSource::parse(source)).collect();
        let catalogue = Catalogue::open(&sources)?;
        let listed: Vec<Listed> = catalogue.entries().iter().map(Listed::of).collect();
        if self.json { print_json(&listed) } else { print(&as_table(&listed)) }
    }
}

impl<'a> Listed<'a> {
    fn of(entry: &'a Entry) -> Self {
        let task = Tracking::default();
        let look_ahead = task.reference_steps.iter().copied().max().unwrap_or(0);
        let starts = entry.starts(look_ahead, task.min_steps);
        Self {
            clip: &entry.name,
            frames: entry.steps,
            seconds: entry.dt * entry.steps as f64,
            dt: entry.dt,
            model: entry.model.to_string(),
            subsets: subsets_with(&entry.name),
            starts: (!starts.is_empty()).then_some([starts.start, starts.end]),
            made_from: entry.made_from.as_deref(),
        }
    }
}

fn as_table(listed: &[Listed]) -> String {
    let row = |clip: &Listed| {
        [
            clip.clip.to_string(),
            clip.frames.to_string(),
            format!("{:.2}", clip.seconds),
            clip.starts.map_or_else(|| "none".into(), |[first, end]| format!("{first}..{end}")),
            clip.model.clone(),
            // A clip made of others has a name of its own, which is in no subset.
            clip.made_from.map_or_else(|| clip.subsets.join(", "), |made_from| format!("made from: {made_from}")),
        ]
    };
    let rows: Vec<_> = listed.iter().map(row).collect();
    let seconds: f64 = listed.iter().map(|clip| clip.seconds).sum();
    let frames: usize = listed.iter().map(|clip| clip.frames).sum();
    let total = format!("{} clips, {frames} frames, {seconds:.1} s\n", listed.len());
    table(["clip", "frames", "seconds", "starts", "body", "subsets"], &rows) + &total
}
