//! The part of a file that an experiment uses, as a file of its own.

use std::path::{Path, PathBuf};

use sha2::{Digest as _, Sha256};

use crate::error::Error;
use crate::file::ClipFile;
use crate::write::ClipWriter;

/// Characters of the name of a file.
const NAME: usize = 32;

/// A file in `directory` with these clips of `file`, whose SHA-256 is `sha256`. Clips and features are the same, bit for bit; markers,
/// props and dates are not copied. A file that is there already is used, because its name says what it was made of.
///
/// # Errors
/// [`Error::Unwritable`], [`Error::Malformed`].
pub(crate) fn cut(file: &ClipFile, sha256: &[u8; 32], names: &[String], directory: &Path) -> Result<PathBuf, Error> {
    let mut origin = Sha256::new_with_prefix(sha256);
    names.iter().for_each(|name| origin.update(format!("{name}/")));
    let mut name = hex::encode(origin.finalize());
    name.truncate(NAME);
    let path = directory.join(name).with_extension("h5");
    if path.exists() {
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
