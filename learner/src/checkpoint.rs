//! The checkpoint directory; no other module touches it.
//!
//! A checkpoint is a directory `checkpoint-NNNNNNNNNN` (the number of updates) with one file per part and a
//! `MANIFEST.json` that holds each part's SHA-256. It is written beside its final name, synced, renamed, and the parent
//! synced, so that a crash leaves either the whole checkpoint or none. Two more, `initial` and `warm-started`, are kept
//! for comparison. `best.json` says which one was evaluated best; it is kept, too, and the link `best` leads to it.

mod best;
#[cfg(test)]
mod crash;
mod run;
mod steps;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail};
use sha2::{Digest as _, Sha256};

use best::Best;
pub use best::{Evaluated, Judgement};
use steps::{Step, carry_out, hidden, is_damage, put, replace};

use crate::error::Error;

const MANIFEST: &str = "MANIFEST.json";
const EPOCH: &str = "epoch";
/// Of a checkpoint that another one of the same name takes the place of.
const FORMER: &str = "former-";
/// Of a checkpoint that does not verify.
const DAMAGED: &str = "damaged-";
/// The part that says which life of the learner made a checkpoint, and what it had published.
pub(crate) const PROGRESS: &str = "progress.json";

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

impl Name {
    /// The name that is spelt like this, if it is one.
    fn parse(text: &str) -> Option<Self> {
        match text {
            "initial" => Some(Self::Initial),
            "warm-started" => Some(Self::WarmStarted),
            _ => {
                let digits = text.strip_prefix("checkpoint-")?;
                let well_formed = digits.len() == 10 && digits.bytes().all(|byte| byte.is_ascii_digit());
                well_formed.then(|| digits.parse().ok().map(Self::Updates)).flatten()
            }
        }
    }
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
        carry_out(&making(&directory))?;
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
    /// [`Error::Configuration`] when the epoch file is damaged; otherwise when it cannot be read or written.
    pub fn begin_epoch(&self) -> Result<u64> {
        let path = self.directory.join(EPOCH);
        let last = match fs::read(&path) {
            Ok(bytes) => String::from_utf8_lossy(&bytes).trim().parse::<u64>().map_err(|_| {
                let remedy = "write the number of earlier starts into it";
                Error::configuration(format!("{} is damaged: {remedy}", path.display()))
            })?,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => 0,
            Err(error) => return Err(error).with_context(|| format!("cannot read {}", path.display())),
        };
        let epoch = last.checked_add(1).context("the learner epoch is exhausted")?;
        carry_out(&replace(&path, epoch.to_string().into_bytes()))?;
        if let Some(best) = self.best() {
            self.lead_to(best.name())?;
        }
        Ok(epoch)
    }

    /// Clears away what is half-written, and brings back what had stepped aside for it.
    fn put_right(&self) -> Result<()> {
        carry_out(&self.repairs()?)
    }

    fn repairs(&self) -> Result<Vec<Step<'static>>> {
        let mut repairs = Vec::new();
        for path in entries(&self.directory)? {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let Some(name) = name.strip_prefix('.') else { continue };
            match name.strip_prefix(FORMER).and_then(Name::parse) {
                Some(former) if !self.has(former) => repairs.extend(put(path, &self.path(former))),
                Some(_) => repairs.push(Step::Remove(path)),
                None if Name::parse(name).is_some() => repairs.push(Step::Remove(path)),
                None => {}
            }
        }
        if !repairs.is_empty() {
            // What took a former one's name keeps it, before the former one goes.
            repairs.insert(0, Step::SyncDirectory(self.directory.clone()));
        }
        Ok(repairs)
    }

    fn path(&self, name: Name) -> PathBuf {
        self.directory.join(name.to_string())
    }

    /// Writes a checkpoint whole, and forgets the oldest beyond the number kept.
    ///
    /// # Errors
    /// When the disk refuses; earlier checkpoints stay as they were, and what was written of this one is taken away.
    pub fn write(&self, name: Name, snapshot: &Snapshot) -> Result<PathBuf> {
        let path = self.path(name);
        if let Err(error) = carry_out(&self.steps(name, snapshot)?) {
            // On a full disk the next one may need the room.
            if let Err(left) = self.put_right() {
                tracing::warn!("{left:#}");
            }
            return Err(error);
        }
        Ok(path)
    }

    /// How a checkpoint comes to be: the whole of it under another name, then its own.
    fn steps<'a>(&self, name: Name, snapshot: &'a Snapshot) -> Result<Vec<Step<'a>>> {
        let path = self.path(name);
        let temporary = hidden("", &path);
        let mut steps = vec![Step::Remove(temporary.clone()), Step::MakeDirectory(temporary.clone())];
        let mut part = |name: &str, bytes: std::borrow::Cow<'a, [u8]>| {
            let path = temporary.join(name);
            steps.extend([Step::Write(path.clone(), bytes), Step::SyncFile(path)]);
        };
        let mut manifest = BTreeMap::new();
        for (name, bytes) in &snapshot.parts {
            manifest.insert(name, hex(&Sha256::digest(bytes)));
            part(name, bytes.into());
        }
        part(MANIFEST, serde_json::to_vec_pretty(&manifest)?.into());
        steps.push(Step::SyncDirectory(temporary.clone()));
        // One of the same name steps aside first: at no moment is neither of them there.
        let former = hidden(FORMER, &path);
        steps.push(Step::Remove(former.clone()));
        if path.exists() {
            steps.push(Step::Rename(path.clone(), former.clone()));
        }
        steps.extend(put(temporary, &path));
        steps.push(Step::Remove(former));
        steps.extend(self.oldest_beside(name)?.into_iter().map(Step::Remove));
        Ok(steps)
    }

    /// Those that are beyond the number kept once there is another, and are not the best.
    fn oldest_beside(&self, written: Name) -> Result<Vec<PathBuf>> {
        let mut numbers: Vec<u64> = numbered(&self.directory)?.into_iter().map(|(updates, _)| updates).collect();
        if let Name::Updates(updates) = written {
            numbers.push(updates);
            numbers.sort_unstable();
            numbers.dedup();
        }
        numbers.truncate(numbers.len().saturating_sub(self.kept));
        let best = self.best().map(Best::name);
        let forgotten = numbers.into_iter().map(Name::Updates).filter(|name| *name != written && Some(*name) != best);
        Ok(forgotten.map(|name| self.path(name)).collect())
    }

    /// The newest checkpoint whose every part verifies. Damaged ones are put aside as `damaged-…`, with a warning, and
    /// what an earlier life left half-done is put right.
    ///
    /// # Errors
    /// When something cannot be listed or read; [`Error::Configuration`] when there are, or were, checkpoints and none of them verifies:
    /// beginning anew beside them would be a loss nobody asked for.
    pub fn newest(&self) -> Result<Option<(PathBuf, Snapshot)>> {
        self.put_right()?;
        let numbered = numbered(&self.directory)?;
        for (_, path) in numbered.iter().rev() {
            match read(path) {
                Ok(snapshot) => return Ok(Some((path.clone(), snapshot))),
                Err(error) if is_damage(&error) => self.put_aside(path, &error)?,
                Err(error) => return Err(error),
            }
        }
        // At every start, not at the first alone.
        let named = |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(DAMAGED));
        let Some(aside) = entries(&self.directory)?.into_iter().find(named) else { return Ok(None) };
        let (all, remedy) = (
            self.directory.display(),
            "mend one and give it its name back, remove it to begin anew, or give another --run",
        );
        let said = format!("every checkpoint in {all} is damaged, as {} is: {remedy}", aside.display());
        Err(Error::Configuration(said).into())
    }

    fn put_aside(&self, path: &Path, error: &anyhow::Error) -> Result<()> {
        tracing::warn!(checkpoint = %path.display(), "a damaged checkpoint is put aside: {error:#}");
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let aside = self.directory.join(format!("{DAMAGED}{name}"));
        Step::Remove(aside.clone()).carry_out()?;
        carry_out(&put(path.to_path_buf(), &aside))
    }

    /// Whether a checkpoint of this name is there.
    pub fn has(&self, name: Name) -> bool {
        self.path(name).is_dir()
    }
}

/// What to say of a run whose checkpoint verifies and cannot be gone on with: the next start would find the same, unless it
/// was the device that failed.
pub(crate) fn incompatible(run: &Path, error: impl Into<Error>) -> Error {
    let (what, error) = (format!("{} cannot be resumed", run.display()), error.into());
    if error.is_device_failure() {
        return Error::within(what)(error);
    }
    Error::configuration(format!("{what}: {}", comic_proto::chain(&error)))
}

/// How a directory comes to be, with those above it that are missing: what is synced in one that nobody finds is lost with it.
fn making(directory: &Path) -> Vec<Step<'static>> {
    let named = |place: &&Path| !place.as_os_str().is_empty();
    let missing: Vec<_> = directory.ancestors().take_while(|place| named(place) && !place.is_dir()).collect();
    let steps = missing.into_iter().rev().flat_map(|place| {
        let above = place.parent().filter(named).unwrap_or(Path::new("."));
        [Step::MakeDirectory(place.to_path_buf()), Step::SyncDirectory(above.to_path_buf())]
    });
    steps.collect()
}

fn entries(directory: &Path) -> Result<Vec<PathBuf>> {
    let listed = || fs::read_dir(directory)?.map(|entry| entry.map(|entry| entry.path())).collect();
    std::io::Result::with_context(listed(), || format!("cannot list {}", directory.display()))
}

/// Numbered checkpoints and their numbers, oldest first.
fn numbered(directory: &Path) -> Result<Vec<(u64, PathBuf)>> {
    let mut found = Vec::new();
    for path in entries(directory)? {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if let Some(Name::Updates(updates)) = Name::parse(&name)
            && path.is_dir()
        {
            found.push((updates, path));
        }
    }
    found.sort();
    Ok(found)
}

/// The newest whole checkpoint that `path` names, and where it lies: a run's directory, its `checkpoints`, or one of them,
/// `checkpoints/best` for instance.
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
    for (_, path) in numbered(&directory)?.into_iter().rev() {
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

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_that_fails_is_no_wrong_checkpoint() {
        let failed = |error: anyhow::Error| incompatible(Path::new("runs/a"), error.context("cannot be restored"));
        assert_eq!(failed(tch::TchError::Torch("out of memory".into()).into()).exit_code(), 1);
        assert_eq!(
            failed(crate::algorithm::error::Error::from(tch::TchError::Torch("out of memory".into())).into())
                .exit_code(),
            1
        );
        assert_eq!(failed(anyhow::anyhow!("the checkpoint does not fit")).exit_code(), 2);
    }

    #[test]
    fn what_is_no_text_in_its_small_files_is_damage_with_a_remedy() {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(directory.path(), 1).unwrap();
        for (name, remedy) in [(EPOCH, "earlier starts"), ("run", "start the actors again")] {
            fs::write(store.directory.join(name), b"\xff\xfe1").unwrap();
            let refused = if name == EPOCH { store.begin_epoch() } else { store.run() }.unwrap_err();
            let refused = Error::from(refused);
            assert!(refused.exit_code() == 2 && refused.to_string().contains(remedy), "{refused:#}");
        }
    }
}
