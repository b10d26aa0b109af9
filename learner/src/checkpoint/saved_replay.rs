//! The saved replay of a run: one file beside the checkpoints, of the newest checkpoint that has one. It is written apart from them,
//! because it can be a thousand times as large.

use std::fs::File;
use std::io::{self, BufReader, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

use crate::checkpoint::name::entries;
use crate::checkpoint::steps::{Step, carry_out, hidden, put};
use crate::error::{Error, Result};

/// Begins the name of the file. The number of updates of its checkpoint follows.
const NAME: &str = "replay-";

/// The place of a run's saved replay.
#[derive(Debug)]
pub(crate) struct SavedReplay {
    directory: PathBuf,
}

impl SavedReplay {
    /// That of the run in this directory.
    pub(crate) fn of(run: &Path) -> Self {
        Self::within(&run.join("checkpoints"))
    }

    /// That of a directory of checkpoints.
    pub(super) fn within(checkpoints: &Path) -> Self {
        Self { directory: checkpoints.to_path_buf() }
    }

    fn path(&self, updates: u64) -> PathBuf {
        self.directory.join(format!("{NAME}{updates:010}"))
    }

    /// Checks that the volume has room for `bytes` more.
    ///
    /// # Errors
    /// [`Error::Configuration`] when it has not; otherwise when it does not say.
    pub(crate) fn check_room(&self, bytes: u64) -> Result<()> {
        let volume =
            rustix::fs::statvfs(&self.directory).map_err(|error| Error::file("ask", &self.directory)(error.into()))?;
        let (free, place) = (volume.f_bavail.saturating_mul(volume.f_frsize), self.directory.display());
        if free >= bytes {
            return Ok(());
        }
        let [free, needed] = [free, bytes].map(|bytes| bytes >> 20);
        Err(Error::configuration(format!(
            "replay.save: the volume of {place} has {free} MiB free, and the saved replay takes up to {needed} MiB (twice its size \
             while it is replaced): make room, or make replay.max_size smaller"
        )))
    }

    /// Writes the replay of the checkpoint after so many updates. That of an earlier one stays.
    ///
    /// # Errors
    /// When the disk refuses; then nothing is left of it.
    pub(crate) fn write(&self, updates: u64, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<()> {
        let path = self.path(updates);
        let temporary = hidden("", &path);
        let written = File::create(&temporary).and_then(|file| {
            let mut writer = BufWriter::with_capacity(1 << 20, file);
            write(&mut writer)?;
            writer.flush()
        });
        let [rename, sync] = put(temporary.clone(), &path);
        let kept = written
            .map_err(Error::file("write", &temporary))
            .and_then(|()| carry_out(&[Step::SyncFile(temporary.clone()), rename, sync]));
        if kept.is_err() {
            let _ = Step::Remove(temporary).carry_out();
        }
        kept
    }

    /// The replay of the checkpoint after so many updates; `None` if it has none.
    ///
    /// # Errors
    /// When it cannot be opened.
    pub(crate) fn open(&self, updates: u64) -> Result<Option<(PathBuf, BufReader<File>)>> {
        let path = self.path(updates);
        match File::open(&path) {
            Ok(file) => Ok(Some((path, BufReader::with_capacity(1 << 20, file)))),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            Err(error) => Err(Error::file("open", &path)(error)),
        }
    }

    /// Bytes of the replay of the checkpoint after so many updates; 0 if it has none.
    pub(crate) fn size(&self, updates: u64) -> u64 {
        self.path(updates).metadata().map_or(0, |found| found.len())
    }

    /// Removes the replays of earlier checkpoints, if this one has one.
    ///
    /// # Errors
    /// When the disk refuses.
    pub(crate) fn remove_earlier(&self, updates: u64) -> Result<()> {
        let replaced = self.path(updates).is_file();
        self.remove(|found| replaced && found < updates)
    }

    /// Removes what is half-written, and the replays of checkpoints that the run does not have: those after `updates`, with
    /// which it begins.
    ///
    /// # Errors
    /// When the disk refuses.
    pub(crate) fn tidy(&self, updates: u64) -> Result<()> {
        for path in entries(&self.directory)? {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if name.strip_prefix('.').is_some_and(|name| name.starts_with(NAME)) {
                Step::Remove(path).carry_out()?;
            }
        }
        self.remove(|found| found > updates)
    }

    /// Removes the replay of a checkpoint that could not be written.
    ///
    /// # Errors
    /// When the disk refuses.
    pub(super) fn forget(&self, updates: u64) -> Result<()> {
        Step::Remove(self.path(updates)).carry_out()
    }

    fn remove(&self, unwanted: impl Fn(u64) -> bool) -> Result<()> {
        for path in entries(&self.directory)? {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            let updates = name.strip_prefix(NAME).and_then(|digits| digits.parse().ok());
            if updates.is_some_and(&unwanted) {
                Step::Remove(path).carry_out()?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::io::Read as _;

    use super::*;

    #[test]
    fn the_newest_replay_stays_and_a_failed_one_leaves_nothing() {
        let run = tempfile::tempdir().unwrap();
        fs::create_dir(run.path().join("checkpoints")).unwrap();
        let replay = SavedReplay::of(run.path());
        let contents = |updates: u64| {
            replay.open(updates).unwrap().map(|(_, mut file)| {
                let mut text = String::new();
                file.read_to_string(&mut text).unwrap();
                text
            })
        };
        replay.write(1, |writer| writer.write_all(b"one")).unwrap();
        replay.write(2, |writer| writer.write_all(b"two")).unwrap();
        replay.remove_earlier(2).unwrap();
        assert_eq!((contents(1), contents(2).as_deref()), (None, Some("two")));
        let full = || io::Error::from(ErrorKind::StorageFull);
        let refused = replay.write(3, |writer| writer.write_all(b"half").and(Err(full()))).unwrap_err();
        assert!(refused.to_string().contains("replay-0000000003"), "{refused}");
        // The checkpoint after three updates has none, so the one before keeps its own.
        replay.remove_earlier(3).unwrap();
        assert_eq!(contents(2).as_deref(), Some("two"));
        // A run that begins again with the second checkpoint.
        replay.write(4, |writer| writer.write_all(b"four")).unwrap();
        fs::write(run.path().join("checkpoints/.replay-0000000005"), b"half").unwrap();
        replay.tidy(2).unwrap();
        assert_eq!((contents(2).as_deref(), contents(4), replay.size(2)), (Some("two"), None, 3));
        assert_eq!(fs::read_dir(run.path().join("checkpoints")).unwrap().count(), 1);
    }

    #[test]
    fn a_volume_without_room_is_refused_with_the_remedy() {
        let run = tempfile::tempdir().unwrap();
        fs::create_dir(run.path().join("checkpoints")).unwrap();
        let replay = SavedReplay::of(run.path());
        assert!(replay.check_room(1).is_ok());
        let refused = replay.check_room(u64::MAX).unwrap_err();
        assert!(refused.exit_code() == 2 && refused.to_string().contains("replay.max_size"), "{refused}");
    }
}
