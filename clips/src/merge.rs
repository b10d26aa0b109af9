//! One file of several.

use std::path::Path;

use comic_experiment::ClipSource;

use crate::catalogue::Catalogue;
use crate::error::Error;
use crate::write::ClipWriter;

/// Writes the clips of all `sources` into one new file, whole, in the order of the sources; returns how many. Built-in
/// clips get their features by forward kinematics. Only what is used of a clip goes along: markers, props and dates of
/// the recording do not.
///
/// # Errors
/// As [`Catalogue::open`], [`Catalogue::load`] and [`ClipWriter`]: a clip that cannot be read is not merged.
pub fn merge(
    sources: &[ClipSource],
    path: &Path,
    overwrite: bool,
    mut progress: impl FnMut(usize, usize),
) -> Result<usize, Error> {
    let catalogue = Catalogue::open(sources)?;
    let clips = catalogue.entries().len();
    let mut writer = ClipWriter::create(path, overwrite)?;
    for index in 0..clips {
        writer.add(&catalogue.load(index)?)?;
        progress(index + 1, clips);
    }
    writer.finish()?;
    Ok(clips)
}
