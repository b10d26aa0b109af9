//! What is done to a disk, one step after another. A crash may come between any two steps, and loses what was not synced;
//! `crash.rs` tests this.

use std::borrow::Cow;
use std::fs::{self, File};
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};

/// One change of the disk.
#[derive(Clone, Debug)]
pub(super) enum Step<'a> {
    MakeDirectory(PathBuf),
    /// Writes a file, replacing one of the same name.
    Write(PathBuf, Cow<'a, [u8]>),
    /// Makes the contents of a file last.
    SyncFile(PathBuf),
    /// Makes the names in a directory last.
    SyncDirectory(PathBuf),
    Rename(PathBuf, PathBuf),
    /// A symbolic link of this name that points to the target.
    Link(PathBuf, String),
    /// A file, a link, or a directory and everything in it. It need not exist.
    Remove(PathBuf),
}

impl Step<'_> {
    /// Carries out the step.
    ///
    /// # Errors
    /// When the disk refuses, with the path.
    pub(super) fn carry_out(&self) -> Result<()> {
        match self {
            // Another learner may make the same directories at this moment; the lock decides which learner continues.
            Self::MakeDirectory(path) => fs::create_dir(path)
                .or_else(|error| if path.is_dir() { Ok(()) } else { Err(error) })
                .map_err(Error::file("make", path)),
            Self::Write(path, bytes) => {
                File::create(path).and_then(|mut file| file.write_all(bytes)).map_err(Error::file("write", path))
            }
            Self::SyncFile(path) | Self::SyncDirectory(path) => {
                File::open(path).and_then(|file| file.sync_all()).map_err(Error::file("sync", path))
            }
            Self::Rename(from, to) => rename(from, to),
            Self::Link(path, target) => {
                std::os::unix::fs::symlink(target, path).map_err(Error::file("make the link", path))
            }
            Self::Remove(path) => remove(path),
        }
    }
}

/// Carries out steps in order, up to the first that fails.
///
/// # Errors
/// That one's.
pub(super) fn carry_out(steps: &[Step<'_>]) -> Result<()> {
    steps.iter().try_for_each(Step::carry_out)
}

/// Replaces a file by one with these contents. After a crash there is one of the two, and it is whole.
pub(super) fn replace(path: &Path, bytes: Vec<u8>) -> [Step<'static>; 4] {
    let temporary = hidden("", path);
    let [rename, sync] = put(temporary.clone(), path);
    [Step::Write(temporary.clone(), bytes.into()), Step::SyncFile(temporary), rename, sync]
}

/// Replaces a file that is no checkpoint. If the disk refuses, the former one stays, and nothing else is left.
///
/// # Errors
/// When the disk refuses, with the path.
pub(crate) fn replace_file(path: &Path, bytes: Vec<u8>) -> Result<()> {
    let replaced = carry_out(&replace(path, bytes));
    if replaced.is_err() {
        drop(remove(&hidden("", path)));
    }
    replaced
}

/// Gives a file or directory that is whole and synced its final name.
pub(super) fn put(temporary: PathBuf, path: &Path) -> [Step<'static>; 2] {
    let directory = path.parent().unwrap_or(path).to_path_buf();
    [Step::Rename(temporary, path.to_path_buf()), Step::SyncDirectory(directory)]
}

/// A name beside `path` that nothing else uses: `.PREFIXname`.
pub(super) fn hidden(prefix: &str, path: &Path) -> PathBuf {
    path.with_file_name(format!(".{prefix}{}", path.file_name().unwrap_or_default().to_string_lossy()))
}

#[allow(clippy::disallowed_methods, reason = "the one durable rename: contents synced before, directory after")]
fn rename(from: &Path, to: &Path) -> Result<()> {
    fs::rename(from, to).map_err(Error::file("rename a file to", to))
}

fn remove(path: &Path) -> Result<()> {
    let removed = match path.symlink_metadata() {
        Ok(found) if found.is_dir() => fs::remove_dir_all(path),
        Ok(_) => fs::remove_file(path),
        Err(error) => Err(error),
    };
    match removed {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(Error::file("remove", path)(error)),
        _ => Ok(()),
    }
}

/// Makes a directory, and the missing directories above it. Each is synced in its parent, because a directory that no one
/// can find after a crash loses everything in it.
pub(super) fn making(directory: &Path) -> Vec<Step<'static>> {
    let named = |place: &&Path| !place.as_os_str().is_empty();
    let missing: Vec<_> = directory.ancestors().take_while(|place| named(place) && !place.is_dir()).collect();
    let steps = missing.into_iter().rev().flat_map(|place| {
        let above = place.parent().filter(named).unwrap_or(Path::new("."));
        [Step::MakeDirectory(place.to_path_buf()), Step::SyncDirectory(above.to_path_buf())]
    });
    steps.collect()
}
