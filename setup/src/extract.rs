//! Unpacks a wheel into `.deps`: first into a temporary directory, then every file to its path.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use zip::ZipArchive;

use crate::interrupt::Interrupt;
use crate::progress::Progress;
use crate::wheel::{Extent, Wheel};

/// Unpacks the wanted files of `wheel` from `archive` into `dependencies`, and returns them with their sizes.
///
/// Until every file is written, only the directory `unfinished` changes in `dependencies`.
pub(crate) fn extract(
    wheel: &Wheel,
    archive: &Path,
    dependencies: &Path,
    extent: Extent,
    interrupt: &Interrupt,
) -> Result<BTreeMap<PathBuf, u64>> {
    let unfinished = dependencies.join("unfinished");
    let _ = fs::remove_dir_all(&unfinished);
    let mut files = unpack(wheel, archive, &unfinished, extent, interrupt)?;
    for &(link, target) in wheel.links {
        make_link(&unfinished.join(link), target)?;
        let size = fs::metadata(unfinished.join(link)).with_context(|| format!("{link} points to no file"))?.len();
        files.insert(link.into(), size);
    }
    for file in files.keys() {
        let place = dependencies.join(file);
        make_parent(&place)?;
        rename(&unfinished.join(file), &place)?;
    }
    fs::remove_dir_all(&unfinished).with_context(|| format!("cannot remove {}", unfinished.display()))?;
    Ok(files)
}

fn unpack(
    wheel: &Wheel,
    archive: &Path,
    unfinished: &Path,
    extent: Extent,
    interrupt: &Interrupt,
) -> Result<BTreeMap<PathBuf, u64>> {
    let file = File::open(archive).with_context(|| format!("cannot open {}", archive.display()))?;
    let mut zip = ZipArchive::new(std::io::BufReader::with_capacity(1 << 20, file))
        .with_context(|| format!("{} is not a wheel", archive.display()))?;
    let mut wanted = Vec::new();
    let mut total = 0;
    for index in 0..zip.len() {
        let entry = zip.by_index_raw(index).with_context(|| format!("{} is damaged", archive.display()))?;
        if entry.is_dir() || entry.enclosed_name().is_none() {
            continue;
        }
        if let Some(place) = (wheel.place)(entry.name(), extent) {
            total += entry.size();
            wanted.push((index, place, entry.size()));
        }
    }
    if wanted.is_empty() {
        bail!("{} contains none of the files wanted from {}", archive.display(), wheel.name);
    }
    let mut progress = Progress::start(format!("unpacking {} {}", wheel.name, wheel.version), total);
    let mut done = 0;
    for (index, place, _) in &wanted {
        let mut entry = zip.by_index(*index).with_context(|| format!("{} is damaged", archive.display()))?;
        copy(&mut entry, &unfinished.join(place), interrupt, |bytes| {
            done += bytes;
            progress.set(done);
        })?;
    }
    progress.finish();
    Ok(wanted.into_iter().map(|(_, place, size)| (place, size)).collect())
}

fn copy(from: &mut impl Read, to: &Path, interrupt: &Interrupt, mut copied: impl FnMut(u64)) -> Result<()> {
    make_parent(to)?;
    let mut file = File::create(to).with_context(|| format!("cannot write {}", to.display()))?;
    let mut buffer = vec![0; 1 << 18];
    loop {
        let count = from.read(&mut buffer).with_context(|| format!("cannot unpack {}", to.display()))?;
        if count == 0 {
            return Ok(());
        }
        file.write_all(&buffer[..count]).with_context(|| format!("cannot write {}", to.display()))?;
        copied(count as u64);
        if interrupt.requested() {
            bail!("interrupted; `cargo xtask setup` continues with this wheel");
        }
    }
}

fn make_parent(path: &Path) -> Result<()> {
    let Some(parent) = path.parent() else { return Ok(()) };
    fs::create_dir_all(parent).with_context(|| format!("cannot make {}", parent.display()))
}

#[cfg(unix)]
fn make_link(link: &Path, target: &str) -> Result<()> {
    std::os::unix::fs::symlink(target, link).with_context(|| format!("cannot link {}", link.display()))
}

#[cfg(not(unix))]
fn make_link(link: &Path, target: &str) -> Result<()> {
    fs::copy(link.with_file_name(target), link).map(drop).with_context(|| format!("cannot copy {}", link.display()))
}

/// Moves a complete file to its path.
// The workspace disallows bare renames because they are not durable. Here they need not be: after a power cut the stamp
// differs from the files, and set-up unpacks the wheel again.
#[allow(clippy::disallowed_methods)]
pub(crate) fn rename(from: &Path, to: &Path) -> Result<()> {
    fs::rename(from, to).with_context(|| format!("cannot move {} to {}", from.display(), to.display()))
}
