//! What a replay holds when a learner epoch begins.

use std::path::Path;

use crate::algorithm::replay::Replay;
use crate::checkpoint::incompatible;
use crate::checkpoint::saved_replay::SavedReplay;
use crate::error::{Error, Result};

/// Begins with the replay that was saved with the checkpoint after `resumed` updates, or with an empty one.
///
/// # Errors
/// When it cannot be read, or when the disk has no room for the next one.
pub(super) fn begin_replay(
    replay: &mut Replay,
    saved: Option<&SavedReplay>,
    resumed: Option<u64>,
    run: &Path,
) -> Result<()> {
    let updates = resumed.unwrap_or(0);
    let Some(saved) = saved else {
        if resumed.is_some() {
            tracing::warn!("the replay begins empty, because replay.save is off");
        }
        return Ok(());
    };
    saved.tidy(updates)?;
    match saved.open(updates)?.filter(|_| resumed.is_some()) {
        Some((path, mut file)) => {
            let remedy = format!("{}: remove it to begin with an empty replay", path.display());
            replay.read_from(&mut file).map_err(|error| incompatible(run, Error::within(remedy)(error)))?;
        }
        None if resumed.is_some() => tracing::warn!("the replay begins empty: none was saved with this checkpoint"),
        None => {}
    }
    // While one is replaced, there are two.
    saved.check_room((2 * replay.memory()).saturating_sub(saved.size(updates)))
}
