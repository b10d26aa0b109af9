//! What is done to a disk, one step after another. A crash may come between any two of them, and takes with it what was
//! not synced: `crash.rs` tries it.

use std::borrow::Cow;
use std::fs::{self, File};
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};

/// One step.
#[derive(Clone, Debug)]
pub(super) enum Step<'a> {
    MakeDirectory(PathBuf),
    /// A file, in place of another of this name.
    Write(PathBuf, Cow<'a, [u8]>),
    /// What is in the file lasts.
    SyncFile(PathBuf),
    /// Which files are in the directory, and what they are called, lasts.
    SyncDirectory(PathBuf),
    Rename(PathBuf, PathBuf),
    /// A symbolic link of this name that leads to the target.
    Link(PathBuf, String),
    /// A file, a link, or a directory with all that is in it; nothing where there is none.
    Remove(PathBuf),
}

impl Step<'_> {
    /// Does it.
    ///
    /// # Errors
    /// When the disk refuses, with the path.
    pub(super) fn carry_out(&self) -> Result<()> {
        match self {
            // Another learner may make the directories of the same run just now: whose it is, the lock decides.
            Self::MakeDirectory(path) => fs::create_dir(path)
                .or_else(|error| if path.is_dir() { Ok(()) } else { Err(error) })
                .with_context(|| format!("cannot make {}", path.display())),
            Self::Write(path, bytes) => File::create(path)
                .and_then(|mut file| file.write_all(bytes))
                .with_context(|| format!("cannot write {}", path.display())),
            Self::SyncFile(path) | Self::SyncDirectory(path) => File::open(path)
                .and_then(|file| file.sync_all())
                .with_context(|| format!("cannot sync {}", path.display())),
            Self::Rename(from, to) => rename(from, to),
            Self::Link(path, target) => {
                std::os::unix::fs::symlink(target, path).with_context(|| format!("cannot link {}", path.display()))
            }
            Self::Remove(path) => remove(path),
        }
    }
}

/// Does them in order, up to the first that fails.
///
/// # Errors
/// That one's.
pub(super) fn carry_out(steps: &[Step<'_>]) -> Result<()> {
    steps.iter().try_for_each(Step::carry_out)
}

/// Puts a file with these contents in the place of another: after a crash one of the two is there, whole.
pub(super) fn replace(path: &Path, bytes: Vec<u8>) -> [Step<'static>; 4] {
    let temporary = hidden("", path);
    let [rename, sync] = put(temporary.clone(), path);
    [Step::Write(temporary.clone(), bytes.into()), Step::SyncFile(temporary), rename, sync]
}

/// Gives what is whole and synced its name.
pub(super) fn put(temporary: PathBuf, path: &Path) -> [Step<'static>; 2] {
    let directory = path.parent().unwrap_or(path).to_path_buf();
    [Step::Rename(temporary, path.to_path_buf()), Step::SyncDirectory(directory)]
}

/// A name beside `path` that nothing else has: `.PREFIXname`.
pub(super) fn hidden(prefix: &str, path: &Path) -> PathBuf {
    path.with_file_name(format!(".{prefix}{}", path.file_name().unwrap_or_default().to_string_lossy()))
}

#[allow(clippy::disallowed_methods, reason = "the one durable rename: contents synced before, directory after")]
fn rename(from: &Path, to: &Path) -> Result<()> {
    fs::rename(from, to).with_context(|| format!("cannot put {} in place", to.display()))
}

fn remove(path: &Path) -> Result<()> {
    let removed = match path.symlink_metadata() {
        Ok(found) if found.is_dir() => fs::remove_dir_all(path),
        Ok(_) => fs::remove_file(path),
        Err(error) => Err(error),
    };
    match removed {
        Err(error) if error.kind() != ErrorKind::NotFound => {
            Err(error).with_context(|| format!("cannot remove {}", path.display()))
        }
        _ => Ok(()),
    }
}

/// Whether it is the checkpoint that is at fault, and not a disk that does not answer or a file that may not be read.
pub(super) fn is_damage(error: &anyhow::Error) -> bool {
    let failed = error.chain().find_map(|cause| cause.downcast_ref::<std::io::Error>());
    failed.is_none_or(|failed| failed.kind() == std::io::ErrorKind::NotFound)
}
