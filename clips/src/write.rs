//! Writes files in dm_control's layout. A file is written completely or not at all.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use hdf5_pure::{
    AttrValue, DatasetBuilder, File, FileAccessProperties, FileCreateProperties, MemoryStrategy, StagedGroup,
    SyncPolicy,
};
use tempfile::NamedTempFile;

use crate::clip::{Clip, Features, Motion, STEPS};
use crate::error::Error;
use crate::file::{MADE_FROM, check_origin};

/// Bytes of datasets that are kept in memory before they are written.
const STAGED: usize = 64 << 20;
/// Greatest length of a clip's name, bytes.
pub(crate) const LONGEST_NAME: usize = 200;
/// How the name of a file that is not complete begins and ends. The file stays if the process is killed.
pub(crate) const UNFINISHED: [&str; 2] = [".clips-", ".part"];
/// Compression level; 6 is zlib's default.
const DEFLATE: u32 = 6;

/// Writes clips into a temporary file beside `path`. [`ClipWriter::finish`] syncs the file and moves it to `path`; a
/// writer that is dropped earlier leaves no file. Memory use does not grow with the file.
pub struct ClipWriter {
    path: PathBuf,
    overwrite: bool,
    temporary: NamedTempFile,
    file: File,
    names: BTreeSet<String>,
    staged: usize,
}

impl ClipWriter {
    /// Begins a file. An existing file is replaced only if `overwrite` is true.
    ///
    /// # Errors
    /// [`Error::Exists`], [`Error::Unwritable`].
    pub fn create(path: &Path, overwrite: bool) -> Result<Self, Error> {
        if path.exists() && !overwrite {
            return Err(Error::Exists { path: path.into() });
        }
        let directory = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let temporary = temporary(directory).map_err(|error| unwritable(path, &error))?;
        // One sync at the end is enough: until then the file is temporary.
        let access = FileAccessProperties::new()
            .with_sync_policy(SyncPolicy::OnClose)
            .with_memory_strategy(MemoryStrategy::Bounded);
        let file = File::create_with_options(temporary.path(), FileCreateProperties::new(), access)
            .map_err(|error| unwritable(path, &error))?;
        Ok(Self { path: path.into(), overwrite, temporary, file, names: BTreeSet::new(), staged: 0 })
    }

    /// Adds a clip. Forward kinematics of the V2020 body computes the features of a clip that has none.
    ///
    /// # Errors
    /// [`Error::Name`], [`Error::NameTaken`], [`Error::Unwritable`]; [`Error::Length`] and [`Error::Edit`] for a number
    /// of frames and a [`Clip::made_from`] that this program does not read back.
    pub fn add(&mut self, clip: &Clip) -> Result<(), Error> {
        let forbidden = |character: char| matches!(character, '/' | '.') || character.is_whitespace();
        if clip.name.is_empty() || clip.name.len() > LONGEST_NAME || clip.name.chars().any(forbidden) {
            return Err(Error::Name { name: clip.name.clone() });
        }
        if !STEPS.contains(&(clip.steps() as u64)) {
            return Err(Error::Length { name: clip.name.clone(), steps: clip.steps() });
        }
        if let Some(Err(allowed)) = clip.made_from.as_deref().map(check_origin) {
            let reason = format!("{MADE_FROM} {allowed}; make the clip of recordings with short and plain names");
            return Err(Error::Edit { name: clip.name.clone(), reason });
        }
        if !self.names.insert(clip.name.clone()) {
            return Err(Error::NameTaken { name: clip.name.clone() });
        }
        let features = clip.features.clone().unwrap_or_else(|| Features::of(&clip.motion));
        let datasets = datasets(&clip.motion, &features);
        self.staged += datasets.iter().map(|(_, frames)| size_of_val(*frames)).sum::<usize>();
        let written = self.file.root().create_group_with(&clip.name, |group| stage(group, clip, &datasets));
        written.map_err(|error| unwritable(&self.path, &error))?;
        if self.staged >= STAGED {
            self.commit()?;
        }
        Ok(())
    }

    /// The number of clips that were added.
    pub(crate) fn clips(&self) -> usize {
        self.names.len()
    }

    fn commit(&mut self) -> Result<(), Error> {
        self.staged = 0;
        self.file.commit().map_err(|error| unwritable(&self.path, &error))
    }

    /// Syncs the file, moves it to its path, and syncs the directory.
    ///
    /// # Errors
    /// [`Error::Exists`] if another file was created at the path in the meantime; [`Error::Unwritable`].
    pub fn finish(mut self) -> Result<(), Error> {
        self.commit()?;
        let Self { path, overwrite, temporary, file, .. } = self;
        file.close().map_err(|error| unwritable(&path, &error))?;
        temporary.as_file().sync_all().map_err(|error| unwritable(&path, &error))?;
        let placed = if overwrite { temporary.persist(&path) } else { temporary.persist_noclobber(&path) };
        let file = placed.map_err(|failed| match failed.error.kind() {
            std::io::ErrorKind::AlreadyExists => Error::Exists { path: path.clone() },
            _ => unwritable(&path, &failed.error),
        })?;
        drop(file);
        // A crash cannot lose the new name after the directory is synced.
        let directory = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        std::fs::File::open(directory)
            .and_then(|directory| directory.sync_all())
            .map_err(|error| unwritable(&path, &error))
    }
}

fn unwritable(path: &Path, error: &dyn std::fmt::Display) -> Error {
    Error::Unwritable { path: path.into(), reason: error.to_string() }
}

/// A temporary file with the usual permissions of a new file. By default only the owner can read it.
fn temporary(directory: &Path) -> std::io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    let [beginning, ending] = UNFINISHED;
    builder.prefix(beginning).suffix(ending);
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    builder.tempfile_in(directory)
}

/// All datasets, each frame by frame.
fn datasets<'a>(motion: &'a Motion, features: &'a Features) -> [(&'static str, &'a [f64]); 11] {
    [
        ("position", motion.position.as_flattened()),
        ("quaternion", motion.quaternion.as_flattened()),
        ("joints", motion.joints.as_flattened()),
        ("velocity", motion.velocity.as_flattened()),
        ("angular_velocity", motion.angular_velocity.as_flattened()),
        ("joints_velocity", motion.joints_velocity.as_flattened()),
        ("center_of_mass", features.center_of_mass.as_flattened()),
        ("end_effectors", features.end_effectors.as_flattened()),
        ("appendages", features.appendages.as_flattened()),
        ("body_positions", &features.body_positions),
        ("body_quaternions", &features.body_quaternions),
    ]
}

/// Stages one clip in dm_control's layout (`locomotion/mocap/loader.py`, `mocap.proto`). Its loader needs every group
/// and attribute, so unknown ones are empty. It ignores [`MADE_FROM`].
fn stage(group: &mut StagedGroup<'_>, clip: &Clip, datasets: &[(&str, &[f64])]) {
    let steps = clip.steps();
    for date in ["year", "month", "day"] {
        group.set_attr(date, AttrValue::I64(0));
    }
    group.set_attr("dt", AttrValue::F64(clip.dt)).set_attr("num_steps", AttrValue::I64(steps as i64));
    if let Some(made_from) = &clip.made_from {
        group.set_attr(MADE_FROM, AttrValue::String(made_from.clone()));
    }
    group.create_group("props");
    group.create_group_with("walkers", |walkers| {
        walkers.create_group_with("walker_0", |walker| {
            walker.set_attr("name", AttrValue::AsciiString("walker".into()));
            walker.set_attr("model", AttrValue::I64(clip.model.attribute()));
            walker.set_attr("mass", AttrValue::F64(0.0));
            walker.set_attr("end_effector_names", AttrValue::AsciiStringArray(Vec::new()));
            walker.set_attr("appendage_names", AttrValue::AsciiStringArray(Vec::new()));
            walker.create_group("markers").create_group("scaling");
            for (field, frames) in datasets {
                walker.create_dataset(field, |dataset| columns(dataset, frames, steps));
            }
        });
    });
}

/// A dataset `(dim, T)` with a column per frame. It is one compressed chunk, because clips are read as a whole.
fn columns(dataset: &mut DatasetBuilder, frames: &[f64], steps: usize) {
    let width = frames.len() / steps.max(1);
    let rows: Vec<f64> = (0..width).flat_map(|row| frames.iter().skip(row).step_by(width).copied()).collect();
    let shape = [width as u64, steps as u64];
    dataset.with_f64_data(&rows).with_shape(&shape).with_chunks(&shape).with_shuffle().with_deflate(DEFLATE);
}
