//! Files that are read again when they change.

use std::fmt;
use std::os::unix::fs::MetadataExt as _;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use comic_proto::chain;
use parking_lot::{Mutex, MutexGuard};

use crate::error::Result;

/// Identifies a state of a file: device, inode, size, and the times of its last changes.
type Stamp = Option<[i64; 7]>;

/// How soon files that could not be used are read again even if they did not change: reading may have failed for want of a file
/// descriptor.
const RETRY: Duration = Duration::from_secs(1);

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
    /// If it is not that of the files as they are, when they were read.
    failed: Option<Instant>,
}

impl<T> Watched<T> {
    /// Reads the files for the first time.
    ///
    /// # Errors
    /// The errors of `load`.
    pub(super) fn new(files: Vec<PathBuf>, load: impl Fn() -> Result<T> + Send + Sync + 'static) -> Result<Self> {
        // Before the files are read, so that a later change is noticed the next time.
        let stamps = stamps(&files);
        let state = State { stamps, usable: Arc::new(load()?), failed: None };
        Ok(Self { files, load: Box::new(load), state: Mutex::new(state) })
    }

    /// The value of the files as they are now; `None` if they cannot be used.
    pub(super) fn current(&self) -> Option<Arc<T>> {
        let state = self.refresh();
        state.failed.is_none().then(|| state.usable.clone())
    }

    /// The value of the files as they were when they could be used last.
    pub(super) fn last_usable(&self) -> Arc<T> {
        self.refresh().usable.clone()
    }

    fn refresh(&self) -> MutexGuard<'_, State<T>> {
        let mut state = self.state.lock();
        let stamps = stamps(&self.files);
        let changed = state.stamps != stamps;
        if changed || state.failed.is_some_and(|failed| failed.elapsed() >= RETRY) {
            state.stamps = stamps;
            match (self.load)() {
                Ok(value) => {
                    state.usable = Arc::new(value);
                    state.failed = None;
                    tracing::info!(files = ?self.files, "changed files are in use");
                }
                Err(error) => {
                    state.failed = Some(Instant::now());
                    if changed {
                        tracing::error!(files = ?self.files, "changed files cannot be used: {}", chain(&error));
                    }
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
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;
    use crate::error::Error;

    #[test]
    fn what_could_not_be_read_is_read_again_although_it_did_not_change() {
        let file = tempfile::NamedTempFile::new().unwrap();
        // As when no file descriptor is left.
        let fails = Arc::new(AtomicBool::new(false));
        let load = {
            let fails = fails.clone();
            move || if fails.load(Ordering::Relaxed) { Err(Error::configuration("unreadable")) } else { Ok(()) }
        };
        let watched = Watched::new(vec![file.path().to_path_buf()], load).unwrap();
        fails.store(true, Ordering::Relaxed);
        std::fs::write(file.path(), "new").unwrap();
        assert!(watched.current().is_none());
        fails.store(false, Ordering::Relaxed);
        let until = Instant::now() + 20 * RETRY;
        while watched.current().is_none() {
            assert!(Instant::now() < until);
            std::thread::yield_now();
        }
    }

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
