//! What the service offers to fetch: files, and the newest checkpoint for evaluators (`GetCheckpoint`).

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use comic_clips::Asset;
use comic_proto::v1;
use parking_lot::Mutex;
use sha2::{Digest as _, Sha256};

use crate::checkpoint::progress::Progress;
use crate::checkpoint::{Name, Snapshot};
use crate::error::Result;

/// How long a checkpoint is held for the evaluator that fetched it.
const HELD: Duration = Duration::from_secs(3600);

/// An asset as `Join` and `GetCheckpoint` describe it.
pub(super) fn description(asset: &Asset) -> v1::Asset {
    v1::Asset { source: asset.source.clone(), sha256: asset.sha256.to_vec(), size: asset.size }
}

/// The newest checkpoint of this learner epoch; a handle that can be cloned.
#[derive(Clone, Debug, Default)]
pub(super) struct NewestCheckpoint {
    offer: Arc<Mutex<Option<Arc<Offer>>>>,
    /// The one that an evaluator fetched last, and when.
    fetched: Arc<Mutex<Option<(Name, Instant)>>>,
}

impl NewestCheckpoint {
    pub(super) fn replace(&self, offer: Offer) {
        *self.offer.lock() = Some(Arc::new(offer));
    }

    pub(super) fn get(&self) -> Option<Arc<Offer>> {
        self.offer.lock().clone()
    }

    /// The file with this hash, for an evaluator that will judge the checkpoint.
    pub(super) fn fetch(&self, sha256: &[u8], now: Instant) -> Option<Asset> {
        let offer = self.get()?;
        let file = offer.file(sha256)?.clone();
        *self.fetched.lock() = Some((Name::Updates(offer.progress.updates), now));
        Some(file)
    }

    /// The checkpoint that an evaluator fetched within the last hour: its judgement may still come.
    pub(super) fn held(&self, now: Instant) -> Option<Name> {
        let lately = |(_, fetched): &(Name, Instant)| now.duration_since(*fetched) < HELD;
        self.fetched.lock().filter(lately).map(|(name, _)| name)
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
    fn file(&self, sha256: &[u8]) -> Option<&Asset> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fetched_checkpoint_is_held_for_an_hour() {
        let (newest, fetched) = (NewestCheckpoint::default(), Instant::now());
        *newest.fetched.lock() = Some((Name::Updates(3), fetched));
        assert_eq!(newest.held(fetched + HELD / 2), Some(Name::Updates(3)));
        assert_eq!(newest.held(fetched + HELD), None);
    }
}
