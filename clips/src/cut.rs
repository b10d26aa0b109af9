//! The part of a file that an experiment uses, as a file of its own.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use sha2::{Digest as _, Sha256};

use crate::error::Error;
use crate::file::ClipFile;
use crate::write::{ClipWriter, UNFINISHED};

/// Characters of the name of a file, before its ending.
const NAME: usize = 32;
const ENDING: &str = ".h5";

/// A file with some clips of another one. Clips and features are the same, bit for bit; markers, props and dates are not copied.
pub(crate) struct Cut<'a> {
    file: &'a ClipFile,
    names: Vec<String>,
    path: PathBuf,
}

impl<'a> Cut<'a> {
    /// These clips of `file`, sorted, whose SHA-256 is `sha256`, for `directory`. Nothing is written yet.
    pub(crate) fn of(file: &'a ClipFile, sha256: &[u8; 32], names: Vec<String>, directory: &Path) -> Self {
        let mut origin = Sha256::new_with_prefix(sha256);
        names.iter().for_each(|name| origin.update(format!("{name}/")));
        let mut name = hex::encode(origin.finalize());
        name.truncate(NAME);
        let path = directory.join(name + ENDING);
        Self { file, names, path }
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Writes the file. One that is there already is used if it reads as these clips, and is replaced if not.
    ///
    /// # Errors
    /// [`Error::Unwritable`]; those of [`ClipFile::load`]; those of [`ClipWriter::add`] for what it does not write.
    pub(crate) fn write(&self) -> Result<(), Error> {
        let Self { file, names, path } = self;
        if has_exactly(path, file, names)? {
            return Ok(());
        }
        if let Some(directory) = path.parent() {
            std::fs::create_dir_all(directory)
                .map_err(|error| Error::Unwritable { path: directory.into(), reason: error.to_string() })?;
        }
        let mut writer = ClipWriter::create(path, true)?;
        for name in names {
            writer.add(&file.load(name)?)?;
        }
        writer.finish()
    }
}

/// Whether the file at `path` has these clips of `file` and no others. Actors read it as this does, so it is enough that the clips are
/// equal. A file that is damaged, or not there, has not.
fn has_exactly(path: &Path, file: &ClipFile, names: &[String]) -> Result<bool, Error> {
    let Ok(found) = ClipFile::open(path) else { return Ok(false) };
    if found.names() != names {
        return Ok(false);
    }
    for name in names {
        let wanted = file.load(name)?;
        if !found.load(name).is_ok_and(|clip| clip == wanted) {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Removes the cuts in `directory` that are not among `kept`, those of an experiment with other clips or of another source, and cuts that
/// were never finished. Everything else stays. A file that cannot be removed costs only its room, and the next call tries again.
pub(crate) fn remove_others(directory: &Path, kept: &[&Cut]) {
    // There is no directory until something was cut.
    for entry in std::fs::read_dir(directory).into_iter().flatten().flatten() {
        let (path, name) = (entry.path(), entry.file_name());
        let is_file = entry.file_type().is_ok_and(|kind| kind.is_file());
        if is_file && (is_cut(&name) || is_unfinished(&name)) && !kept.iter().any(|kept| kept.path == path) {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// Whether a [`Cut`] has such a name.
fn is_cut(name: &OsStr) -> bool {
    let digits = name.to_str().and_then(|name| name.strip_suffix(ENDING)).unwrap_or_default();
    digits.len() == NAME && digits.bytes().all(|digit| matches!(digit, b'0'..=b'9' | b'a'..=b'f'))
}

fn is_unfinished(name: &OsStr) -> bool {
    let [beginning, ending] = UNFINISHED;
    name.to_str().is_some_and(|name| name.starts_with(beginning) && name.ends_with(ending))
}
