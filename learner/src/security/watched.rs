//! Files that are read again when they change.

use std::fmt;
use std::os::unix::fs::MetadataExt as _;
use std::path::PathBuf;
use std::sync::Arc;

use comic_proto::chain;
use parking_lot::Mutex;

use crate::error::Result;

/// Identifies a state of a file: device, inode, size, and the times of its last changes.
type Stamp = Option<[i64; 7]>;

/// A value made of files. [`current`](Self::current) checks whether they changed, which costs one `stat` for each. Nothing
/// polls them; a change takes effect at the next connection. If changed files cannot be used, this is logged and the old
/// value stays.
pub(super) struct Watched<T> {
    files: Vec<PathBuf>,
    load: Box<dyn Fn() -> Result<T> + Send + Sync>,
    state: Mutex<(Vec<Stamp>, Arc<T>)>,
}

impl<T> Watched<T> {
    /// Reads the files for the first time.
    ///
    /// # Errors
    /// The errors of `load`.
    pub(super) fn new(files: Vec<PathBuf>, load: impl Fn() -> Result<T> + Send + Sync + 'static) -> Result<Self> {
        let first = (stamps(&files), Arc::new(load()?));
        Ok(Self { files, load: Box::new(load), state: Mutex::new(first) })
    }

    /// The value of the files as they are now, or the last one that could be used.
    pub(super) fn current(&self) -> Arc<T> {
        let mut state = self.state.lock();
        // Taken before the files are read, so that a later change is noticed the next time.
        let stamps = stamps(&self.files);
        if state.0 != stamps {
            state.0 = stamps;
            match (self.load)() {
                Ok(value) => {
                    state.1 = Arc::new(value);
                    tracing::info!(files = ?self.files, "changed files are in use");
                }
                Err(error) => {
                    tracing::error!(files = ?self.files, "changed files cannot be used; the old ones stay in use: {}", chain(&error));
                }
            }
        }
        state.1.clone()
    }
}

fn stamps(files: &[PathBuf]) -> Vec<Stamp> {
    files.iter().map(|file| Some(stamp(&std::fs::metadata(file).ok()?))).collect()
}

fn stamp(file: &std::fs::Metadata) -> [i64; 7] {
    let (device, inode, size) = (file.dev() as i64, file.ino() as i64, file.len() as i64);
    [device, inode, size, file.mtime(), file.mtime_nsec(), file.ctime(), file.ctime_nsec()]
}

impl<T> fmt::Debug for Watched<T> {
    /// Shows only the files' names, because their contents are secret.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_tuple("Watched").field(&self.files).finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Error;

    #[test]
    fn a_change_takes_effect_at_once_and_an_unusable_one_changes_nothing() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("number");
        std::fs::write(&path, "1").unwrap();
        let read = {
            let path = path.clone();
            move || {
                let text = std::fs::read_to_string(&path).map_err(Error::file("read", &path))?;
                text.parse::<u32>().map_err(|error| Error::configuration(error.to_string()))
            }
        };
        let watched = Watched::new(vec![path.clone()], read).unwrap();
        assert_eq!(*watched.current(), 1);
        std::fs::write(&path, "22").unwrap();
        assert_eq!(*watched.current(), 22);
        std::fs::write(&path, "no number").unwrap();
        assert_eq!(*watched.current(), 22);
        std::fs::remove_file(&path).unwrap();
        assert_eq!(*watched.current(), 22);
        std::fs::write(&path, "333").unwrap();
        assert_eq!(*watched.current(), 333);
    }

    #[test]
    fn the_first_reading_must_succeed() {
        let load = || Err::<(), _>(Error::configuration("unusable"));
        assert!(Watched::new(Vec::new(), load).is_err());
    }
}
