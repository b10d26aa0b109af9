//! The experiment's files, fetched from the learner once and stored under their SHA-256.

use std::collections::HashMap;
use std::fs::File;
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};

use comic_experiment::{Experiment, Transfer};
use comic_networks::export::LONGEST;
use comic_proto::Client;
use comic_proto::v1::{Asset, AssetRequest};
use sha2::{Digest as _, Sha256};
use tempfile::NamedTempFile;

use super::connection::Failure;
use crate::Error;

/// The default directory of the asset cache: `comic` under `XDG_CACHE_HOME` or `~/.cache`.
pub fn default_cache() -> Option<PathBuf> {
    let absolute = |name| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let base = absolute("XDG_CACHE_HOME").or_else(|| absolute("HOME").map(|home| home.join(".cache")))?;
    Some(base.join("comic"))
}

/// Makes every asset a verified file on this machine; returns the file of each source.
pub(crate) async fn fetch(
    client: &mut Client,
    assets: &[Asset],
    cache: Option<&Path>,
) -> Result<HashMap<String, PathBuf>, Failure> {
    if assets.is_empty() {
        return Ok(HashMap::new());
    }
    let cache = cache.map(Path::to_path_buf).or_else(default_cache).ok_or(Failure::Fatal(Error::NoCache))?;
    let directory = cache.join("assets");
    std::fs::create_dir_all(&directory).map_err(|error| Failure::Fatal(Error::file(&directory)(error)))?;
    let mut located = HashMap::new();
    for asset in assets {
        let path = directory.join(file_name(asset)?);
        if is_whole(&path, asset).map_err(Failure::Fatal)? {
            tracing::debug!(source = asset.source, "asset is in the cache");
        } else {
            tracing::info!(source = asset.source, bytes = asset.size, "fetching an asset");
            download(client, asset, &directory, &path).await?;
        }
        located.insert(asset.source.clone(), path);
    }
    Ok(located)
}

/// The frozen low level of a transfer, from the files that [`fetch`] located; `None` in any other experiment.
pub(super) fn low_level(experiment: &Experiment, located: &HashMap<String, PathBuf>) -> Result<Option<Vec<u8>>, Error> {
    let Transfer { low_level, sha256, .. } = &experiment.transfer;
    if !experiment.transfer.is_on() {
        return Ok(None);
    }
    let path = located.get(low_level).ok_or(Error::Disagreement { what: "the frozen low level" })?;
    let mut file = Vec::new();
    let opened = File::open(path).map_err(Error::file(path))?;
    opened.take(LONGEST).read_to_end(&mut file).map_err(Error::file(path))?;
    if hex::encode(Sha256::digest(&file)) != *sha256 {
        return Err(Error::Disagreement { what: "the frozen low level" });
    }
    Ok(Some(file))
}

/// The name in the cache is the hash alone, so that no name from a learner can lead out of the directory.
fn file_name(asset: &Asset) -> Result<String, Failure> {
    if asset.sha256.len() != 32 {
        return Err(broken(asset, format!("its SHA-256 has {} bytes", asset.sha256.len())));
    }
    Ok(hex::encode(&asset.sha256))
}

fn broken(asset: &Asset, reason: String) -> Failure {
    Failure::Fatal(Error::Asset { origin: asset.source.clone(), reason })
}

fn is_whole(path: &Path, asset: &Asset) -> Result<bool, Error> {
    let mut file = match std::fs::File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(false),
        Err(error) => return Err(Error::file(path)(error)),
    };
    if file.metadata().map_err(Error::file(path))?.len() != asset.size {
        return Ok(false);
    }
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        match file.read(&mut buffer).map_err(Error::file(path))? {
            0 => return Ok(hash.finalize()[..] == asset.sha256[..]),
            read => hash.update(&buffer[..read]),
        }
    }
}

/// Writes to a temporary file and renames it, so that another actor on this machine sees the whole file or none.
async fn download(client: &mut Client, asset: &Asset, directory: &Path, path: &Path) -> Result<(), Failure> {
    let local = |error| Failure::Fatal(Error::file(path)(error));
    let mut file = NamedTempFile::new_in(directory).map_err(local)?;
    receive(client, asset, |data| file.write_all(data).map_err(local)).await?;
    file.as_file().sync_all().map_err(local)?;
    file.persist(path).map_err(|error| local(error.error))?;
    Ok(())
}

/// Receives an asset of at most `limit` bytes into memory, and verifies it.
pub(crate) async fn read(client: &mut Client, asset: &Asset, limit: u64) -> Result<Vec<u8>, Failure> {
    if asset.size > limit {
        return Err(broken(asset, format!("it has {} bytes, more than {limit}", asset.size)));
    }
    let mut bytes = Vec::new();
    receive(client, asset, |data| {
        bytes.extend_from_slice(data);
        Ok(())
    })
    .await?;
    Ok(bytes)
}

/// Gives the bytes of an asset to `keep`. It is whole and verified if the result is `Ok`.
async fn receive(
    client: &mut Client,
    asset: &Asset,
    mut keep: impl FnMut(&[u8]) -> Result<(), Failure>,
) -> Result<(), Failure> {
    let mut stream = client.fetch_asset(AssetRequest { sha256: asset.sha256.clone() }).await?.into_inner();
    let mut hash = Sha256::new();
    let mut received = 0_u64;
    while let Some(chunk) = stream.message().await? {
        received += chunk.data.len() as u64;
        if received > asset.size {
            return Err(broken(asset, format!("more than the {} bytes announced", asset.size)));
        }
        hash.update(&chunk.data);
        keep(&chunk.data)?;
    }
    if received < asset.size {
        // The connection was lost; the asset may be correct.
        return Err(Failure::Lost(format!("asset `{}` broke off after {received} bytes", asset.source)));
    }
    if hash.finalize()[..] != asset.sha256[..] {
        return Err(broken(asset, "its SHA-256 differs".to_string()));
    }
    Ok(())
}
