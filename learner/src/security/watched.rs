//! Files that are read again when they change.

use std::fmt;
use std::os::unix::fs::MetadataExt as _;
use std::path::PathBuf;
use std::sync::Arc;

use comic_proto::chain;
use parking_lot::{Mutex, MutexGuard};

use crate::error::Result;

/// Identifies a state of a file: device, inode, size, and the times of its last changes.
type Stamp = Option<[i64; 7]>;

/// A value made of files. Each question checks whether they changed, which costs one `stat` for each. Nothing polls them. That
/// changed files cannot be used is logged.
pub(super) struct Watched<T> {
    files: Vec<PathBuf>,
    load: Box<dyn Fn() -> Result<T> + Send + Sync>,
    state: Mutex<State<T>>,
}

struct State<T> {
    stamps: Vec<Stamp>,
    /// The last value that could be used.
    usable: Arc<T>,
    /// Whether it is that of the files as they are.
    current: bool,
}

impl<T> Watched<T> {
    /// Reads the files for the first time.
    ///
    /// # Errors
    /// The errors of `load`.
    pub(super) fn new(files: Vec<PathBuf>, load: impl Fn() -> Result<T> + Send + Sync + 'static) -> Result<Self> {
        // Before the files are read, so that a later change is noticed the next time.
        let stamps = stamps(&files);
        let state = State { stamps, usable: Arc::new(load()?), current: true };
        Ok(Self { files, load: Box::new(load), state: Mutex::new(state) })
    }

    /// The value of the files as they are now; `None` if they cannot be used.
    pub(super) fn current(&self) -> Option<Arc<T>> {
        let state = self.refresh();
        state.current.then(|| state.usable.clone())
    }

    /// The value of the files as they were when they could be used last.
    pub(super) fn last_usable(&self) -> Arc<T> {
        self.refresh().usable.clone()
    }

    fn refresh(&self) -> MutexGuard<'_, State<T>> {
        let mut state = self.state.lock();
        let stamps = stamps(&self.files);
        if state.stamps != stamps {
            state.stamps = stamps;
            let loaded = (self.load)();
            state.current = loaded.is_ok();
            match loaded {
                Ok(value) => {
                    state.usable = Arc::new(value);
                    tracing::info!(files = ?self.files, "changed files are in use");
                }
                Err(error) => {
                    tracing::error!(files = ?self.files, "changed files cannot be used: {}", chain(&error));
                }
            }
        }
        state
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
    fn a_change_takes_effect_at_once_and_an_unusable_one_leaves_only_the_last_usable_value() {
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
        let found = || (watched.current().as_deref().copied(), *watched.last_usable());
        assert_eq!(found(), (Some(1), 1));
        std::fs::write(&path, "22").unwrap();
        assert_eq!(found(), (Some(22), 22));
        std::fs::write(&path, "no number").unwrap();
        assert_eq!(found(), (None, 22));
        std::fs::remove_file(&path).unwrap();
        assert_eq!(found(), (None, 22));
        std::fs::write(&path, "333").unwrap();
        assert_eq!(found(), (Some(333), 333));
    }

    #[test]
    fn the_first_reading_must_succeed() {
        let load = || Err::<(), _>(Error::configuration("unusable"));
        assert!(Watched::new(Vec::new(), load).is_err());
    }
}
