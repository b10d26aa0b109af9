//! A run's checkpoint directory.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use crate::checkpoint::best::{Best, Evaluated, Judgement};
use crate::checkpoint::name::{Name, entries, numbered};
use crate::checkpoint::saved_replay::SavedReplay;
use crate::checkpoint::snapshot::{MANIFEST, Snapshot, checksum, read};
use crate::checkpoint::steps::{Step, carry_out, hidden, making, put, replace};
use crate::error::{Error, Result};

const EPOCH: &str = "epoch";
const RUN: &str = "run";
/// Begins the hidden name of a checkpoint while another one of the same name is put in its place.
const FORMER: &str = "former-";
/// Begins the name of a checkpoint that does not verify.
const DAMAGED: &str = "damaged-";

/// A run's checkpoint directory.
#[derive(Debug)]
pub struct Store {
    directory: PathBuf,
    kept: usize,
    /// A checkpoint that is kept in addition.
    held: Option<Name>,
}

impl Store {
    /// Opens (and makes) `RUN/checkpoints`.
    ///
    /// # Errors
    /// [`Error::Configuration`] when a file is in its place; otherwise when it cannot be made.
    pub fn open(run: &Path, kept: usize) -> Result<Self> {
        let directory = run.join("checkpoints");
        let mut places = directory.ancestors();
        if let Some(file) = places.find(|place| place.symlink_metadata().is_ok() && !place.is_dir()) {
            let remedy = "choose a directory with --run";
            return Err(Error::configuration(format!("{} is not a directory: {remedy}", file.display())));
        }
        carry_out(&making(&directory))?;
        Ok(Self { directory, kept: kept.max(1), held: None })
    }

    /// Prevents every other learner from using this run for as long as the guard lives.
    ///
    /// # Errors
    /// When another learner has it.
    pub fn lock(&self) -> Result<File> {
        let path = self.directory.join("lock");
        let file = File::create(&path).map_err(Error::file("write", &path))?;
        let directory = self.directory.display();
        let what = format!("another learner uses {directory}: stop it, or give another --run");
        file.try_lock().map_err(|error| Error::system(what)(error.into()))?;
        Ok(file)
    }

    /// Begins a new learner epoch: a number larger than every earlier one, on disk before it is returned.
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
            Err(error) if error.kind() == ErrorKind::NotFound => 0,
            Err(error) => return Err(Error::file("read", &path)(error)),
        };
        let epoch = last.checked_add(1).ok_or_else(|| Error::configuration("the learner epoch is exhausted"))?;
        carry_out(&replace(&path, epoch.to_string().into_bytes()))?;
        if let Some(best) = Best::read(&self.directory) {
            best.link(&self.directory)?;
        }
        Ok(epoch)
    }

    /// The run's number, drawn at random when the run began. Epochs and versions begin again with every run. By this number,
    /// actors that reconnect to the same address notice that their run is over.
    ///
    /// # Errors
    /// [`Error::Configuration`] when its file is damaged; otherwise when it cannot be read or written.
    pub fn run(&self) -> Result<u64> {
        let path = self.directory.join(RUN);
        match fs::read(&path) {
            Ok(bytes) => u64::from_str_radix(String::from_utf8_lossy(&bytes).trim(), 16).map_err(|_| {
                let remedy = "remove it, and start the actors again";
                Error::configuration(format!("{} is damaged: {remedy}", path.display()))
            }),
            Err(error) if error.kind() == ErrorKind::NotFound => {
                let run = rand::random();
                carry_out(&replace(&path, format!("{run:016x}").into_bytes()))?;
                Ok(run)
            }
            Err(error) => Err(Error::file("read", &path)(error)),
        }
    }

    /// Removes what is half-written, and restores the checkpoints that were moved aside for it.
    fn repair(&self) -> Result<()> {
        carry_out(&self.repairs()?)
    }

    pub(super) fn repairs(&self) -> Result<Vec<Step<'static>>> {
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
            // The new checkpoint's name has to last before the former one is removed.
            repairs.insert(0, Step::SyncDirectory(self.directory.clone()));
        }
        Ok(repairs)
    }

    fn path(&self, name: Name) -> PathBuf {
        name.within(&self.directory)
    }

    /// From now on keeps this checkpoint, in place of the one that was held before.
    pub fn hold(&mut self, checkpoint: Option<Name>) {
        self.held = checkpoint;
    }

    /// Writes a whole checkpoint, and removes the oldest beyond the number kept.
    ///
    /// # Errors
    /// When the disk refuses. Earlier checkpoints stay as they were, and what was written of this one is removed.
    pub fn write(&self, name: Name, snapshot: &Snapshot) -> Result<PathBuf> {
        let path = self.path(name);
        if let Err(error) = carry_out(&self.steps(name, snapshot)?) {
            // On a full disk the next checkpoint may need the space.
            let replay = match name {
                Name::Updates(updates) if !self.has(name) => SavedReplay::within(&self.directory).forget(updates),
                _ => Ok(()),
            };
            if let Err(left) = self.repair().and(replay) {
                tracing::warn!("{}", comic_proto::chain(&left));
            }
            return Err(error);
        }
        if let Name::Updates(updates) = name
            && let Err(left) = SavedReplay::within(&self.directory).remove_earlier(updates)
        {
            tracing::warn!("{}", comic_proto::chain(&left));
        }
        Ok(path)
    }

    /// How a checkpoint is written: all of it under another name, which then becomes its own.
    pub(super) fn steps<'a>(&self, name: Name, snapshot: &'a Snapshot) -> Result<Vec<Step<'a>>> {
        let path = self.path(name);
        let temporary = hidden("", &path);
        let mut steps = vec![Step::Remove(temporary.clone()), Step::MakeDirectory(temporary.clone())];
        let mut part = |name: &str, bytes: std::borrow::Cow<'a, [u8]>| {
            let path = temporary.join(name);
            steps.extend([Step::Write(path.clone(), bytes), Step::SyncFile(path)]);
        };
        let mut manifest = BTreeMap::new();
        for (name, bytes) in &snapshot.parts {
            manifest.insert(name, checksum(bytes));
            part(name, bytes.into());
        }
        part(MANIFEST, serde_json::to_vec_pretty(&manifest).map_err(Error::json(MANIFEST))?.into());
        steps.push(Step::SyncDirectory(temporary.clone()));
        // A checkpoint of the same name is moved aside first, so that one of the two always exists.
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

    /// The checkpoints beyond the number kept once `written` is there, without the best one and the held one.
    fn oldest_beside(&self, written: Name) -> Result<Vec<PathBuf>> {
        let mut numbers: Vec<u64> = numbered(&self.directory)?.into_iter().map(|(updates, _)| updates).collect();
        if let Name::Updates(updates) = written {
            numbers.push(updates);
            numbers.sort_unstable();
            numbers.dedup();
        }
        numbers.truncate(numbers.len().saturating_sub(self.kept));
        let kept = [Some(written), self.held, Best::read(&self.directory).map(Best::name)];
        let forgotten = numbers.into_iter().map(Name::Updates).filter(|name| !kept.contains(&Some(*name)));
        Ok(forgotten.map(|name| self.path(name)).collect())
    }

    /// The newest checkpoint of which every part verifies. Damaged ones are renamed to `damaged-…`, with a warning, and
    /// half-finished work of an earlier epoch is repaired.
    ///
    /// # Errors
    /// When something cannot be listed or read; [`Error::Configuration`] when there are, or were, checkpoints and none of
    /// them verifies: a new beginning beside them would be a loss that no one asked for.
    pub fn newest(&self) -> Result<Option<(PathBuf, Snapshot)>> {
        self.repair()?;
        let numbered = numbered(&self.directory)?;
        for (_, path) in numbered.iter().rev() {
            match read(path) {
                Ok(snapshot) => return Ok(Some((path.clone(), snapshot))),
                Err(error) if is_damage(&error) => self.set_aside(path, &error)?,
                Err(error) => return Err(error),
            }
        }
        // At every start, not only at the first.
        let named = |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(DAMAGED));
        let Some(aside) = entries(&self.directory)?.into_iter().find(named) else { return Ok(None) };
        let (all, aside) = (self.directory.display(), aside.display());
        let remedy = "repair one and give it its name back, remove it to begin again, or give another --run";
        Err(Error::Configuration(format!("every checkpoint in {all} is damaged, for instance {aside}: {remedy}")))
    }

    fn set_aside(&self, path: &Path, error: &Error) -> Result<()> {
        let error = comic_proto::chain(error);
        tracing::warn!(checkpoint = %path.display(), "a damaged checkpoint is set aside: {error}");
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let aside = self.directory.join(format!("{DAMAGED}{name}"));
        Step::Remove(aside.clone()).carry_out()?;
        carry_out(&put(path.to_path_buf(), &aside))
    }

    /// Whether there is a checkpoint of this name.
    pub fn has(&self, name: Name) -> bool {
        self.path(name).is_dir()
    }

    /// Keeps the checkpoint that was evaluated, besides the newest few, if none was better.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn judge(&self, evaluated: Evaluated) -> Result<Judgement> {
        Best::judge(&self.directory, evaluated)
    }
}

/// Whether the checkpoint is at fault, and not a disk that does not answer or a file that may not be read.
fn is_damage(error: &Error) -> bool {
    match error {
        Error::File { source, .. } => source.kind() == ErrorKind::NotFound,
        Error::Within { source, .. } => is_damage(source),
        Error::System { .. } => false,
        _ => true,
    }
}

/// The error of a run whose checkpoint verifies and cannot be resumed. The next start would fail in the same way, so it is a
/// wrong configuration, unless the device failed.
pub(crate) fn incompatible(run: &Path, error: impl Into<Error>) -> Error {
    let (what, error) = (format!("{} cannot be resumed", run.display()), error.into());
    if error.is_device_failure() {
        return Error::within(what)(error);
    }
    Error::configuration(format!("{what}: {}", comic_proto::chain(&error)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_that_fails_does_not_make_a_checkpoint_incompatible() {
        let failed = |error: Error| incompatible(Path::new("runs/a"), Error::within("cannot be restored")(error));
        let torch = || tch::TchError::Torch("out of memory".into());
        assert_eq!(failed(torch().into()).exit_code(), 1);
        assert_eq!(failed(crate::algorithm::error::Error::from(torch()).into()).exit_code(), 1);
        let state = crate::algorithm::error::Error::from(crate::adam::StateError::from(torch()));
        assert_eq!(failed(state.into()).exit_code(), 1);
        assert_eq!(failed(Error::Checkpoint("the checkpoint does not fit".into())).exit_code(), 2);
    }

    #[test]
    fn a_run_in_the_place_of_a_file_is_refused_and_the_error_names_the_remedy() {
        let file = tempfile::NamedTempFile::new().unwrap();
        for run in [file.path(), &file.path().join("below")] {
            let refused = Store::open(run, 1).unwrap_err();
            assert_eq!(refused.exit_code(), 2, "{refused}");
            let said = refused.to_string();
            assert!(said.contains(&file.path().display().to_string()) && said.contains("--run"), "{said}");
        }
    }

    #[test]
    fn a_small_file_that_is_not_text_is_damaged_and_the_error_names_the_remedy() {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(directory.path(), 1).unwrap();
        for (name, remedy) in [(EPOCH, "earlier starts"), (RUN, "start the actors again")] {
            fs::write(store.directory.join(name), b"\xff\xfe1").unwrap();
            let refused = if name == EPOCH { store.begin_epoch() } else { store.run() }.unwrap_err();
            assert!(refused.exit_code() == 2 && refused.to_string().contains(remedy), "{refused}");
        }
    }
}
