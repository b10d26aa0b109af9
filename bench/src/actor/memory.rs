//! Whether resets leak memory.

use std::fs;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context as _, Result};
use comic_clips::Catalogue;

use super::Subject;
use crate::figure::{Figure, Medians};

/// Resets after which the allocator has reserved what it needs.
const WARM: usize = 1_000;
/// All resets; the memory must not have grown after the first of them.
const RESETS: usize = 10_000;

/// The process's resident memory after many resets, against that after a tenth of them. Every reset draws and compiles a
/// new corridor.
pub(super) fn memory(subject: &Subject) -> Result<[Figure; 2]> {
    let mut experiment = subject.experiment.clone();
    experiment.gaps.corridor.arena_steps = 0;
    experiment.walls.corridor.arena_steps = 0;
    let task = comic_tasks::build(&experiment, &Catalogue::open(&experiment.clips)?)?;
    let mut environment = Arc::clone(&task).environment(1)?;
    let mut milliseconds = |resets: usize| {
        let begun = Instant::now();
        (0..resets).for_each(|_| environment.reset());
        begun.elapsed().as_secs_f64() * 1000.0 / resets as f64
    };
    let first = milliseconds(WARM);
    let floor = resident()?;
    let _ = milliseconds(RESETS - 2 * WARM);
    let last = milliseconds(WARM);
    let note = "resident memory after 10,000 resets, arenas compiled at each; floor: after 1,000";
    let memory = Figure::new("actor.memory", "MiB", Medians { value: resident()?, floor }, note);
    // A small list that grows, and that every reset walks through, shows in the time.
    let note = "a reset of the last thousand, with its arena compiled; floor: of the first thousand";
    Ok([memory, Figure::new("actor.memory.reset", "ms", Medians { value: last, floor: first }, note)])
}

/// Resident memory of this process, MiB.
pub(super) fn resident() -> Result<f64> {
    const PATH: &str = "/proc/self/status";
    let status = fs::read_to_string(PATH).with_context(|| format!("cannot read {PATH}"))?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kibibytes = line.and_then(|line| line.trim().trim_end_matches(" kB").parse::<f64>().ok());
    let kibibytes = kibibytes.with_context(|| format!("{PATH} has no resident memory"))?;
    Ok(kibibytes / 1024.0)
}
