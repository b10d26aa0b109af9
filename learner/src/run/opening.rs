//! What rank 0 tells the other ranks at the start of a learner epoch.

use std::path::PathBuf;

use comic_clips::{Asset, Catalogue};
use comic_experiment::{Difference, Experiment};
use serde::{Deserialize, Serialize};

use crate::checkpoint::Snapshot;
use crate::error::{Error, Result};
use crate::world::World;

/// Most bytes of a checkpoint, and most parts.
const LONGEST: usize = 16 << 30;
const MOST_PARTS: usize = 64;

/// A learner epoch that has begun.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct Epoch {
    /// The learner epoch.
    pub(super) epoch: u64,
    /// The run's number.
    pub(super) run: u64,
}

/// Checks that all ranks have the experiment and the clips of rank 0. Each may have another device of the same kind.
///
/// # Errors
/// [`Error::Configuration`] with every field and file that is different.
pub(super) fn check_equality(world: &World, experiment: &Experiment, catalogue: &Catalogue) -> Result<()> {
    if world.size() == 1 {
        return Ok(());
    }
    let hash = |asset: Asset| (asset.source, hex::encode(asset.sha256));
    let own: Vec<_> = catalogue.assets(None)?.into_iter().map(hash).collect();
    let said = world.exchange((experiment.to_toml()?, own.clone()))?;
    let Some((document, files)) = said.into_iter().next() else { return Ok(()) };
    let mut first = Experiment::from_toml("the experiment of rank 0", &document)?;
    if std::mem::discriminant(&first.learner.device) == std::mem::discriminant(&experiment.learner.device) {
        first.learner.device = experiment.learner.device;
    }
    let differs = |Difference { field, ours, theirs }| format!("{field} is {ours} there and {theirs} here");
    let mut differences: Vec<String> = first.differences(experiment)?.into_iter().map(differs).collect();
    let others = own.iter().filter(|file| !files.contains(file));
    differences.extend(others.map(|(source, _)| format!("{source} is another file there and here")));
    if differences.is_empty() {
        return Ok(());
    }
    Err(Error::Configuration(format!(
        "rank 0 has another experiment ({}): give all ranks the same files, --preset, --experiment and --set",
        differences.join("; ")
    )))
}

/// The checkpoint of rank 0, with its path there.
///
/// # Errors
/// When another rank is lost.
pub(super) fn share_checkpoint(
    world: &World,
    newest: Option<(PathBuf, Snapshot)>,
) -> Result<Option<(PathBuf, Snapshot)>> {
    if world.size() == 1 {
        return Ok(newest);
    }
    let sizes = |(path, snapshot): &(PathBuf, Snapshot)| {
        let sizes: Vec<_> = snapshot.parts.iter().map(|(name, part)| (name.clone(), part.len())).collect();
        (path.display().to_string(), sizes)
    };
    let said = world.exchange(newest.as_ref().map(sizes))?;
    let Some((path, sizes)) = said.into_iter().next().flatten() else { return Ok(None) };
    let mut own = newest.map(|(_, snapshot)| snapshot.parts).unwrap_or_default();
    let mut shared = Snapshot::default();
    let whole = sizes.iter().fold(0usize, |sum, (_, size)| sum.saturating_add(*size));
    if whole > LONGEST || sizes.len() > MOST_PARTS {
        let parts = sizes.len();
        let allowed = format!("{LONGEST} bytes in {MOST_PARTS} parts are allowed");
        return Err(Error::Checkpoint(format!("rank 0's checkpoint has {whole} bytes in {parts} parts; {allowed}")));
    }
    for (name, size) in sizes {
        let part = own.remove(&name).unwrap_or_else(|| vec![0; size]);
        shared.parts.insert(name, world.broadcast(part)?);
    }
    Ok(Some((PathBuf::from(path), shared)))
}

/// The epoch that rank 0 has begun.
///
/// # Errors
/// When another rank is lost.
pub(super) fn share_epoch(world: &World, begun: Option<Epoch>) -> Result<Epoch> {
    let said = world.exchange(begun)?;
    let epoch = said.into_iter().next().flatten();
    epoch.ok_or_else(|| Error::Defect("rank 0 has not begun an epoch".into()))
}
