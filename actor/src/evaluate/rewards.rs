//! The reward of every step, for comparisons with other programs.

use std::fmt::Write as _;
use std::path::Path;

use comic_experiment::TaskSpec;

use super::Finished;
use crate::Error;

/// Writes one JSON object an episode, by clip and start: `{"clip": name, "start": frame, "rewards": [..]}`.
pub(super) fn write(path: &Path, spec: &TaskSpec, finished: &[Finished]) -> Result<(), Error> {
    let mut episodes: Vec<&Finished> = finished.iter().collect();
    episodes.sort_by_key(|episode| (episode.clip, episode.start));
    let mut lines = String::new();
    for Finished { clip, start, rewards, .. } in episodes {
        let line = serde_json::json!({ "clip": spec.clips.get(*clip), "start": start, "rewards": rewards });
        // Writing to a string cannot fail.
        let _ = writeln!(lines, "{line}");
    }
    std::fs::write(path, lines).map_err(Error::file(path))
}
