//! The checkpoint directory; no other module touches it.
//!
//! A checkpoint is a directory `checkpoint-NNNNNNNNNN` (the number of updates) with one file per part and a
//! `MANIFEST.json` that holds each part's SHA-256. It is written beside its final name, synced, renamed, and the parent
//! synced, so that a crash leaves either the whole checkpoint or none. Two more, `initial` and `warm-started`, are kept
//! for comparison.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail};
use sha2::{Digest as _, Sha256};

const MANIFEST: &str = "MANIFEST.json";
const EPOCH: &str = "epoch";

/// A host snapshot of everything that changes the future: file names and their bytes.
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
        self.parts.get(name).map(Vec::as_slice).with_context(|| format!("the checkpoint has no part `{name}`"))
    }

    /// One part that is text.
    ///
    /// # Errors
    /// When it is absent or not UTF-8.
    pub fn text(&self, name: &str) -> Result<&str> {
        std::str::from_utf8(self.part(name)?).with_context(|| format!("checkpoint part `{name}` is not UTF-8"))
    }
}

/// What a checkpoint is called.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Name {
    /// Before any learning; kept.
    Initial,
    /// After the warm start, before V-MPO; kept.
    WarmStarted,
    /// After so many updates; the newest few are kept.
    Updates(u64),
}

impl std::fmt::Display for Name {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Initial => f.write_str("initial"),
            Self::WarmStarted => f.write_str("warm-started"),
            Self::Updates(updates) => write!(f, "checkpoint-{updates:010}"),
        }
    }
}

/// A run's checkpoint directory.
#[derive(Debug)]
pub struct Store {
    directory: PathBuf,
    kept: usize,
}

impl Store {
    /// Opens (and makes) `RUN/checkpoints`.
    ///
    /// # Errors
    /// When the directory cannot be made.
    pub fn open(run: &Path, kept: usize) -> Result<Self> {
        let directory = run.join("checkpoints");
        fs::create_dir_all(&directory).with_context(|| format!("cannot make {}", directory.display()))?;
        Ok(Self { directory, kept: kept.max(1) })
    }

    /// Keeps every other learner off this run for as long as the guard lives.
    ///
    /// # Errors
    /// When another learner has it.
    pub fn lock(&self) -> Result<File> {
        let path = self.directory.join("lock");
        let file = File::create(&path).with_context(|| format!("cannot write {}", path.display()))?;
        file.try_lock().with_context(|| {
            format!("another learner uses {}: stop it, or give another --run", self.directory.display())
        })?;
        Ok(file)
    }

    /// Begins a new life of the learner: an epoch larger than every earlier one, on disk before it is returned.
    ///
    /// # Errors
    /// When the epoch file is unreadable or cannot be written.
    pub fn begin_life(&self) -> Result<u64> {
        let path = self.directory.join(EPOCH);
        let last = match fs::read_to_string(&path) {
            Ok(text) => text.trim().parse::<u64>().with_context(|| {
                format!("{} is damaged: write the number of earlier starts into it", path.display())
            })?,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => 0,
            Err(error) => return Err(error).with_context(|| format!("cannot read {}", path.display())),
        };
        let epoch = last.checked_add(1).context("the learner epoch is exhausted")?;
        let temporary = self.directory.join(".epoch");
        write_synced(&temporary, epoch.to_string().as_bytes())?;
        self.put(&temporary, &path)?;
        Ok(epoch)
    }

    /// Writes a checkpoint whole, and forgets the oldest beyond the number kept.
    ///
    /// # Errors
    /// When the disk refuses; earlier checkpoints stay as they were.
    pub fn write(&self, name: Name, snapshot: &Snapshot) -> Result<PathBuf> {
        let path = self.directory.join(name.to_string());
        let temporary = self.directory.join(format!(".{name}"));
        remove_if_there(&temporary)?;
        fs::create_dir(&temporary).with_context(|| format!("cannot make {}", temporary.display()))?;
        let mut manifest = BTreeMap::new();
        for (part, bytes) in &snapshot.parts {
            write_synced(&temporary.join(part), bytes)?;
            manifest.insert(part, hex(&Sha256::digest(bytes)));
        }
        write_synced(&temporary.join(MANIFEST), &serde_json::to_vec_pretty(&manifest)?)?;
        sync_directory(&temporary)?;
        // One of the same name steps aside first: at no moment is neither of them there.
        let former = self.directory.join(format!(".former-{name}"));
        remove_if_there(&former)?;
        if path.exists() {
            self.put(&path, &former)?;
        }
        self.put(&temporary, &path)?;
        remove_if_there(&former)?;
        self.forget_oldest(&path)?;
        Ok(path)
    }

    /// The newest checkpoint whose every part verifies. Damaged ones are put aside as `damaged-…`, with a warning.
    ///
    /// # Errors
    /// When the directory cannot be listed, or when there are checkpoints and none of them verifies: beginning anew
    /// beside them would be a loss nobody asked for.
    pub fn newest(&self) -> Result<Option<(PathBuf, Snapshot)>> {
        let numbered = numbered(&self.directory)?;
        for path in numbered.iter().rev() {
            match read(path) {
                Ok(snapshot) => return Ok(Some((path.clone(), snapshot))),
                Err(error) => self.put_aside(path, &error)?,
            }
        }
        if !numbered.is_empty() {
            bail!("every checkpoint in {} is damaged: mend one, or give another --run", self.directory.display());
        }
        Ok(None)
    }

    fn put_aside(&self, path: &Path, error: &anyhow::Error) -> Result<()> {
        tracing::warn!(checkpoint = %path.display(), "a damaged checkpoint is put aside: {error:#}");
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let aside = self.directory.join(format!("damaged-{name}"));
        remove_if_there(&aside)?;
        self.put(path, &aside)
    }

    /// Whether a checkpoint of this name is there.
    pub fn has(&self, name: Name) -> bool {
        self.directory.join(name.to_string()).is_dir()
    }

    /// Keeps the newest few, and in any case the one just written.
    fn forget_oldest(&self, written: &Path) -> Result<()> {
        let numbered = numbered(&self.directory)?;
        let oldest = &numbered[..numbered.len().saturating_sub(self.kept)];
        oldest.iter().filter(|path| *path != written).try_for_each(|path| remove_if_there(path))
    }

    #[allow(clippy::disallowed_methods, reason = "the one durable rename: contents synced before, directory after")]
    fn put(&self, temporary: &Path, path: &Path) -> Result<()> {
        fs::rename(temporary, path).with_context(|| format!("cannot put {} in place", path.display()))?;
        sync_directory(&self.directory)
    }
}

/// Numbered checkpoints, oldest first.
fn numbered(directory: &Path) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(directory).with_context(|| format!("cannot list {}", directory.display()))? {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let digits = name.strip_prefix("checkpoint-").unwrap_or_default();
        if digits.len() == 10 && digits.bytes().all(|byte| byte.is_ascii_digit()) && path.is_dir() {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

/// The newest whole checkpoint that `path` names, and where it lies: a run's directory, its `checkpoints`, or one of them.
/// Of several, a damaged one is passed over with a warning; nothing is changed.
///
/// # Errors
/// When there is none, or the one that was named is damaged.
pub fn find(path: &Path) -> Result<(PathBuf, Snapshot)> {
    if path.join(MANIFEST).is_file() {
        return Ok((path.to_path_buf(), read(path)?));
    }
    let below = path.join("checkpoints");
    let directory = if below.is_dir() { below } else { path.to_path_buf() };
    for path in numbered(&directory)?.into_iter().rev() {
        match read(&path) {
            Ok(snapshot) => return Ok((path, snapshot)),
            Err(error) => tracing::warn!(checkpoint = %path.display(), "passed over a damaged checkpoint: {error:#}"),
        }
    }
    bail!("no complete checkpoint in {}: name a run's directory, its `checkpoints`, or one of them", path.display())
}

/// Reads one checkpoint directory, verifying every part.
///
/// # Errors
/// A part that is missing, or is not what the manifest says.
pub fn read(path: &Path) -> Result<Snapshot> {
    let file = path.join(MANIFEST);
    let text = fs::read(&file).with_context(|| format!("cannot read {}", file.display()))?;
    let manifest: BTreeMap<String, String> =
        serde_json::from_slice(&text).with_context(|| format!("{} is damaged", file.display()))?;
    let mut snapshot = Snapshot::default();
    for (part, expected) in manifest {
        if part.contains(['/', '\\']) || part.starts_with('.') {
            bail!("{}: `{part}` is no part's name", file.display());
        }
        let file = path.join(&part);
        let bytes = fs::read(&file).with_context(|| format!("cannot read {}", file.display()))?;
        if hex(&Sha256::digest(&bytes)) != expected {
            bail!("{} is not what the manifest says: its SHA-256 differs", file.display());
        }
        snapshot.parts.insert(part, bytes);
    }
    Ok(snapshot)
}

fn write_synced(path: &Path, bytes: &[u8]) -> Result<()> {
    let mut file = File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
    file.write_all(bytes).and_then(|()| file.sync_all()).with_context(|| format!("cannot write {}", path.display()))
}

fn sync_directory(path: &Path) -> Result<()> {
    File::open(path).and_then(|file| file.sync_all()).with_context(|| format!("cannot sync {}", path.display()))
}

fn remove_if_there(path: &Path) -> Result<()> {
    match fs::remove_dir_all(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(error).with_context(|| format!("cannot remove {}", path.display()))
        }
        _ => Ok(()),
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
