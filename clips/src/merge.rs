//! Joining several files into one.

use std::path::Path;

use comic_experiment::ClipSource;

use crate::catalogue::Catalogue;
use crate::error::Error;
use crate::write::ClipWriter;

/// Writes all frames of the clips of all `sources` into one new file, in the order of the sources. Returns the number
/// of clips. `progress` gets the number of written clips and the total.
///
/// Forward kinematics computes the features of built-in clips. Markers, props and dates of a recording are not copied.
///
/// # Errors
/// The errors of [`Catalogue::open`], [`Catalogue::load`] and [`ClipWriter`]. If one clip cannot be read, no file is
/// written.
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
