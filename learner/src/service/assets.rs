//! `FetchAsset`: files that actors do not have.

use std::fs::File;
use std::os::unix::fs::FileExt as _;
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use comic_clips::Asset;
use comic_proto::v1::{self, AssetChunk};
use futures::stream::{self, Stream};
use tonic::Status;

use super::offer::NewestCheckpoint;
use super::shutdown::{Shutdown, Signal};

/// Bytes of a chunk.
const CHUNK: u64 = 256 * 1024;
/// Bytes of a SHA-256. A request may hold more, which are not shown.
const HASH: usize = 32;

/// The files of the experiment and of the newest checkpoint.
#[derive(Debug)]
pub(super) struct Assets {
    assets: Vec<Asset>,
    checkpoint: NewestCheckpoint,
    shutdown: Shutdown,
}

impl Assets {
    pub(super) fn new(assets: Vec<Asset>, checkpoint: NewestCheckpoint, shutdown: Shutdown) -> Self {
        Self { assets, checkpoint, shutdown }
    }

    /// The newest checkpoint, as `GetCheckpoint` answers; `None` until this learner epoch has written one.
    pub(super) fn newest_checkpoint(&self) -> Option<v1::Checkpoint> {
        Some(self.checkpoint.get()?.describe(&self.assets))
    }

    fn find(&self, sha256: &[u8]) -> Option<Asset> {
        let of_experiment = self.assets.iter().find(|asset| asset.sha256 == sha256).cloned();
        of_experiment.or_else(|| self.checkpoint.fetch(sha256, Instant::now()))
    }

    /// The asset with this hash in chunks, which are read from disk as the actor takes them.
    pub(super) async fn read(
        &self,
        sha256: &[u8],
    ) -> Result<impl Stream<Item = Result<AssetChunk, Status>> + use<>, Status> {
        let Some(asset) = self.find(sha256) else {
            let hash = hex::encode(&sha256[..sha256.len().min(HASH)]);
            return Err(Status::not_found(format!("this learner has no asset with the SHA-256 {hash}")));
        };
        let path = asset.path.clone();
        let file = blocking(move || File::open(path)).await.map_err(|error| unreadable(&asset, &error))?;
        let reading = Reading { asset, file: Arc::new(file), offset: 0, closing: self.shutdown.closing() };
        Ok(stream::try_unfold(reading, Reading::next))
    }
}

struct Reading {
    asset: Asset,
    file: Arc<File>,
    offset: u64,
    closing: Signal,
}

impl Reading {
    async fn next(mut self) -> Result<Option<(AssetChunk, Self)>, Status> {
        let size = CHUNK.min(self.asset.size - self.offset);
        if size == 0 {
            return Ok(None);
        }
        if self.closing.is_given() {
            return Err(Status::unavailable("the learner is going down: fetch the asset again from the next one"));
        }
        let (file, offset) = (self.file.clone(), self.offset);
        let data = blocking(move || {
            let mut data = vec![0; size as usize];
            file.read_exact_at(&mut data, offset)?;
            Ok(Bytes::from(data))
        })
        .await
        .map_err(|error| unreadable(&self.asset, &error))?;
        self.offset += size;
        Ok(Some((AssetChunk { data }, self)))
    }
}

async fn blocking<T: Send + 'static>(read: impl FnOnce() -> std::io::Result<T> + Send + 'static) -> std::io::Result<T> {
    tokio::task::spawn_blocking(read).await.unwrap_or_else(|stopped| Err(std::io::Error::other(stopped)))
}

fn unreadable(asset: &Asset, error: &std::io::Error) -> Status {
    tracing::error!(asset = %asset.path.display(), %error, "an asset cannot be read; did it change since the start?");
    Status::data_loss(format!("the learner cannot read its asset {}: {error}", asset.source))
}
