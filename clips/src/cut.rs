//! The part of a file that an experiment uses, as a file of its own.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use sha2::{Digest as _, Sha256};

use crate::error::Error;
use crate::file::ClipFile;
use crate::write::ClipWriter;

/// Characters of the name of a file, before its ending.
const NAME: usize = 32;
const ENDING: &str = ".h5";

/// A file in `directory` with these clips of `file`, sorted, whose SHA-256 is `sha256`. Clips and features are the same, bit for bit;
/// markers, props and dates are not copied. A file that is there already is used if it reads as these clips, and is replaced if not.
///
/// # Errors
/// [`Error::Unwritable`]; [`Error::Unreadable`] and [`Error::Malformed`] of `file`.
pub(crate) fn cut(file: &ClipFile, sha256: &[u8; 32], names: &[String], directory: &Path) -> Result<PathBuf, Error> {
    let mut origin = Sha256::new_with_prefix(sha256);
    names.iter().for_each(|name| origin.update(format!("{name}/")));
    let mut name = hex::encode(origin.finalize());
    name.truncate(NAME);
    let path = directory.join(name + ENDING);
    if has_exactly(&path, file, names)? {
        return Ok(path);
    }
    std::fs::create_dir_all(directory)
        .map_err(|error| Error::Unwritable { path: directory.into(), reason: error.to_string() })?;
    let mut writer = ClipWriter::create(&path, true)?;
    for name in names {
        writer.add(&file.load(name)?)?;
    }
    writer.finish()?;
    Ok(path)
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

/// Removes the files in `directory` that [`cut`] made and that are not `kept`: those of an experiment with other clips, or of another source.
/// Everything else stays. A file that cannot be removed costs only its room, and the next call tries again.
pub(crate) fn remove_other_cuts(directory: &Path, kept: &[&Path]) {
    // There is no directory until something was cut.
    for entry in std::fs::read_dir(directory).into_iter().flatten().flatten() {
        let (path, is_file) = (entry.path(), entry.file_type().is_ok_and(|kind| kind.is_file()));
        if is_file && is_cut(&entry.file_name()) && !kept.iter().any(|kept| kept.file_name() == path.file_name()) {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// Whether [`cut`] makes files of such a name.
fn is_cut(name: &OsStr) -> bool {
    let digits = name.to_str().and_then(|name| name.strip_suffix(ENDING)).unwrap_or_default();
    digits.len() == NAME && digits.bytes().all(|digit| matches!(digit, b'0'..=b'9' | b'a'..=b'f'))
}
