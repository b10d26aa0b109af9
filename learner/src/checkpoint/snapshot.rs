//! A checkpoint in memory, and how one is read.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use sha2::{Digest as _, Sha256};

use crate::checkpoint::name::numbered;
use crate::error::{Error, Result};

/// The file of a checkpoint that holds the SHA-256 of each part.
pub(super) const MANIFEST: &str = "MANIFEST.json";
/// The part that says how far the run had come.
pub(crate) const PROGRESS: &str = "progress.json";
/// The part that has everything learned.
pub(crate) const LEARNED: &str = "learner.safetensors";
/// In transfer: the part that is the file of the frozen low level.
pub(crate) const LOW_LEVEL: &str = "low_level.safetensors";
/// What the path of a checkpoint has to name.
const WANTED: &str = "name a run's directory, its `checkpoints`, or one of them";

/// Everything that changes the future, on the host: file names and their bytes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Snapshot {
    /// Parts by file name.
    pub parts: BTreeMap<String, Vec<u8>>,
}

impl Snapshot {
    /// One part.
    ///
    /// # Errors
    /// When the snapshot has no part of this name.
    pub fn part(&self, name: &str) -> Result<&[u8]> {
        let part = self.parts.get(name).map(Vec::as_slice);
        part.ok_or_else(|| Error::Checkpoint(format!("the checkpoint has no part `{name}`")))
    }

    /// # Errors
    /// When it is of another format: other parts may then have another meaning.
    pub(crate) fn check_format(&self) -> Result<()> {
        #[derive(serde::Deserialize)]
        struct Named {
            format: Option<u32>,
        }
        let named: Named =
            serde_json::from_slice(self.part(PROGRESS)?).map_err(Error::json("the checkpoint's progress"))?;
        Ok(comic_experiment::check_checkpoint_format(named.format)?)
    }

    /// One part that is text.
    ///
    /// # Errors
    /// When it is absent or not UTF-8.
    pub fn text(&self, name: &str) -> Result<&str> {
        std::str::from_utf8(self.part(name)?)
            .map_err(|_| Error::Checkpoint(format!("checkpoint part `{name}` is not UTF-8")))
    }
}

/// What the manifest says of a part.
pub(super) fn checksum(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}

/// The newest whole checkpoint that `path` names, and its directory. `path` is a run's directory, its `checkpoints`, or one
/// checkpoint, for instance `checkpoints/best`. If it names several, a damaged one is skipped with a warning. Nothing is
/// changed.
///
/// # Errors
/// [`Error::Configuration`] when there is none, or the one that was named is damaged or of another format; otherwise when the
/// directory cannot be listed.
pub fn find(path: &Path) -> Result<(PathBuf, Snapshot)> {
    let refused = |reason: &str| Error::configuration(format!("checkpoint {}: {reason}; {WANTED}", path.display()));
    if path.join(MANIFEST).is_file() {
        let snapshot = read(path).and_then(|snapshot| snapshot.check_format().map(|()| snapshot));
        return Ok((path.to_path_buf(), snapshot.map_err(|error| refused(&comic_proto::chain(&error)))?));
    }
    if !path.is_dir() {
        return Err(refused("no such directory"));
    }
    let below = path.join("checkpoints");
    let directory = if below.is_dir() { below } else { path.to_path_buf() };
    for (_, path) in numbered(&directory)?.into_iter().rev() {
        match read(&path) {
            Ok(snapshot) => {
                snapshot.check_format().map_err(|error| refused(&comic_proto::chain(&error)))?;
                return Ok((path, snapshot));
            }
            Err(error) => {
                let error = comic_proto::chain(&error);
                tracing::warn!(checkpoint = %path.display(), "skipped a damaged checkpoint: {error}");
            }
        }
    }
    Err(refused("no complete checkpoint here"))
}

/// Reads one checkpoint directory, verifying every part.
///
/// # Errors
/// A part that is missing, or is not what the manifest says.
pub fn read(path: &Path) -> Result<Snapshot> {
    let file = path.join(MANIFEST);
    let text = fs::read(&file).map_err(Error::file("read", &file))?;
    let manifest: BTreeMap<String, String> =
        serde_json::from_slice(&text).map_err(Error::json(file.display().to_string()))?;
    let mut snapshot = Snapshot::default();
    for (part, expected) in manifest {
        if part.contains(['/', '\\']) || part.starts_with('.') {
            return Err(Error::Checkpoint(format!("{}: `{part}` is not the name of a part", file.display())));
        }
        let file = path.join(&part);
        let bytes = fs::read(&file).map_err(Error::file("read", &file))?;
        if checksum(&bytes) != expected {
            let said = format!("{} is not what the manifest says: its SHA-256 differs", file.display());
            return Err(Error::Checkpoint(said));
        }
        snapshot.parts.insert(part, bytes);
    }
    Ok(snapshot)
}
