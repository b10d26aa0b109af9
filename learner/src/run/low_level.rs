//! The frozen low level of a transfer: where the learner finds it, and how actors and checkpoints get it.

use std::path::{Path, PathBuf};

use bytes::Bytes;
use comic_clips::Asset;
use comic_experiment::{Experiment, Transfer};
use comic_networks::export::{Exported, Part};
use sha2::{Digest as _, Sha256};

use crate::checkpoint::snapshot::LOW_LEVEL;
use crate::checkpoint::{self, Snapshot};
use crate::commands::export;
use crate::error::{Error, Result};

/// The file in the run's directory that actors fetch.
const FILE: &str = "low_level.safetensors";

/// A low level that was found, and fits.
pub(super) struct LowLevel {
    /// Its file.
    pub(super) bytes: Bytes,
    sha256: [u8; 32],
}

impl LowLevel {
    /// Finds the experiment's low level, and makes the experiment describe it: its SHA-256 and its sizes. `None` if the
    /// experiment is no transfer. A run that resumes with the same `transfer.low_level` uses the one in its checkpoint:
    /// meanwhile another file may be at that path, or none.
    ///
    /// # Errors
    /// [`Error::Configuration`] when there is none at the path, or it is another one than the experiment names.
    pub(super) fn find(experiment: &mut Experiment, resume: Option<&Snapshot>) -> Result<Option<Self>> {
        if !experiment.transfer.is_on() {
            return Ok(None);
        }
        let kept = resume.and_then(|snapshot| kept(snapshot, &experiment.transfer));
        let reads_action_gradient = experiment.reads_action_gradient();
        let Transfer { low_level, sha256, prior, .. } = &mut experiment.transfer;
        let path = Path::new(low_level.as_str());
        let refused = |problem: String| Error::configuration(format!("transfer.low_level {low_level}: {problem}"));
        let file = match kept {
            Some(bytes) => Exported::read(bytes).map_err(Error::from),
            None if path.is_dir() && low_level.as_str() != Transfer::BUILTIN => {
                let (place, snapshot) = checkpoint::find(path)?;
                export::read(&place, Part::LowLevel, &snapshot)
            }
            None => Exported::open_or_builtin(path).map_err(Error::from),
        };
        let file = file.map_err(|error| refused(comic_proto::chain(&error)))?;
        file.describe_low_level(&mut experiment.network).map_err(|error| refused(error.to_string()))?;
        if reads_action_gradient && experiment.network.components() > 1 {
            let problem = "is a mixture, whose latent only chooses the component, so the simulator's derivative does not reach \
                           it: set vmpo.action_gradient = 0, or give a low level of another kind";
            return Err(refused(problem.into()));
        }
        // Actors would refuse what cannot be built.
        file.freeze(&Transfer { prior: *prior, ..Transfer::default() }).map_err(|error| refused(error.to_string()))?;
        let found: [u8; 32] = Sha256::digest(&file.bytes).into();
        let (expected, hash) = (sha256.to_ascii_lowercase(), hex::encode(found));
        if !expected.is_empty() && expected != hash {
            return Err(refused(format!(
                "its SHA-256 is {hash}, and transfer.sha256 is {expected}: give that file, or leave transfer.sha256 empty"
            )));
        }
        *sha256 = hash;
        tracing::info!(low_level = %path.display(), sha256 = %sha256, "the low level is frozen");
        Ok(Some(Self { bytes: file.bytes.into(), sha256: found }))
    }

    /// Writes it into the run's directory, from where actors fetch it.
    ///
    /// # Errors
    /// A disk that fails.
    pub(super) fn offer(&self, run: &Path, source: String) -> Result<Asset> {
        let path: PathBuf = run.join(FILE);
        // The experiment may name this very file. A write that breaks off must not destroy it.
        let is_there = std::fs::read(&path).is_ok_and(|found| found == self.bytes);
        if !is_there {
            std::fs::write(&path, &self.bytes).map_err(Error::file("write", &path))?;
        }
        Ok(Asset { source, path, sha256: self.sha256, size: self.bytes.len() as u64 })
    }
}

/// The low level in a checkpoint, if the checkpoint's run named the same path.
fn kept(snapshot: &Snapshot, transfer: &Transfer) -> Option<Vec<u8>> {
    let text = snapshot.text("experiment.toml").ok()?;
    let then = Experiment::from_toml("experiment.toml of the checkpoint", text).ok()?;
    let bytes = snapshot.part(LOW_LEVEL).ok()?;
    (then.transfer.low_level == transfer.low_level).then(|| bytes.to_vec())
}
