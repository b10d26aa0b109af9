//! Whether resets leak.

use std::fs;
use std::sync::Arc;

use comic_clips::Catalogue;

use super::Subject;
use super::figure::{Figure, Medians};
use crate::Error;

/// Resets after which the allocator has what it needs.
const WARM: usize = 1_000;
/// Resets after which nothing more may be held.
const RESETS: usize = 10_000;

/// The process's resident memory after many resets, against that after a tenth of them. Corridors are drawn and compiled
/// at every one.
pub(super) fn memory(subject: &Subject) -> Result<Figure, Error> {
    let mut experiment = subject.experiment.clone();
    experiment.gaps.corridor.arena_steps = 0;
    experiment.walls.corridor.arena_steps = 0;
    let task = comic_tasks::build(&experiment, &Catalogue::open(&experiment.clips)?)?;
    let mut environment = Arc::clone(&task).environment(1)?;
    for _ in 0..WARM {
        environment.reset();
    }
    let floor = resident()?;
    for _ in WARM..RESETS {
        environment.reset();
    }
    let note = "resident memory after 10,000 resets, arenas compiled at each; floor: after 1,000";
    Ok(Figure::new("actor.memory", "MiB", Medians { value: resident()?, floor }, note))
}

/// Resident memory, MiB.
fn resident() -> Result<f64, Error> {
    const PATH: &str = "/proc/self/status";
    let status = fs::read_to_string(PATH).map_err(Error::file(PATH))?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kibibytes = line.and_then(|line| line.trim().trim_end_matches(" kB").parse::<f64>().ok());
    let kibibytes = kibibytes.ok_or_else(|| Error::Usage(format!("{PATH} tells no resident memory")))?;
    Ok(kibibytes / 1024.0)
}
