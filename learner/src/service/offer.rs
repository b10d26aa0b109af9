//! What the service offers to fetch: files, and the newest checkpoint for evaluators (`GetCheckpoint`).

use std::path::Path;
use std::sync::Arc;

use comic_clips::Asset;
use comic_proto::v1;
use parking_lot::Mutex;
use sha2::{Digest as _, Sha256};

use crate::checkpoint::Snapshot;
use crate::checkpoint::progress::Progress;
use crate::error::Result;

/// An asset as `Join` and `GetCheckpoint` describe it.
pub(super) fn description(asset: &Asset) -> v1::Asset {
    v1::Asset { source: asset.source.clone(), sha256: asset.sha256.to_vec(), size: asset.size }
}

/// The newest checkpoint of this learner epoch; a handle that can be cloned.
#[derive(Clone, Debug, Default)]
pub(super) struct NewestCheckpoint {
    offer: Arc<Mutex<Option<Arc<Offer>>>>,
}

impl NewestCheckpoint {
    pub(super) fn replace(&self, offer: Offer) {
        *self.offer.lock() = Some(Arc::new(offer));
    }

    pub(super) fn get(&self) -> Option<Arc<Offer>> {
        self.offer.lock().clone()
    }
}

/// A checkpoint that evaluators may fetch.
#[derive(Debug)]
pub struct Offer {
    progress: Progress,
    experiment: Asset,
    policy: Asset,
}

impl Offer {
    /// The checkpoint that was written to the directory `path`.
    ///
    /// # Errors
    /// When a part is absent or damaged.
    pub fn new(path: &Path, snapshot: &Snapshot) -> Result<Self> {
        let file = |name: &str| -> Result<Asset> {
            let bytes = snapshot.part(name)?;
            let (path, sha256) = (path.join(name), Sha256::digest(bytes).into());
            Ok(Asset { source: name.to_owned(), path, sha256, size: bytes.len() as u64 })
        };
        let progress = Progress::of(snapshot)?;
        Ok(Self { progress, experiment: file("experiment.toml")?, policy: file("policy.safetensors")? })
    }

    /// The file with this hash.
    pub(super) fn file(&self, sha256: &[u8]) -> Option<&Asset> {
        [&self.experiment, &self.policy].into_iter().find(|file| file.sha256 == sha256)
    }

    /// As `GetCheckpoint` answers, for an experiment with these files of clips.
    pub(super) fn describe(&self, clips: &[Asset]) -> v1::Checkpoint {
        let Progress { run, epoch, updates, environment_steps, seconds, version, .. } = self.progress;
        v1::Checkpoint {
            run: run.unwrap_or_default(),
            learner_epoch: epoch,
            version,
            updates,
            environment_steps,
            seconds,
            experiment: Some(description(&self.experiment)),
            policy: Some(description(&self.policy)),
            assets: clips.iter().map(description).collect(),
        }
    }
}
