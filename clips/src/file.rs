//! An HDF5 file in the layout of dm_control's mocap files. Each clip is read on its own.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    sync::Arc,
};

use hdf5_reader::{FileStorage, Hdf5File, OpenOptions, Storage, error::Error as Hdf5Error, group::Group};

use crate::clip::{Clip, Features, Motion, STEPS};
use crate::error::Error;
use crate::humanoid::WalkerModel;

/// Longest allowed time step, s. dm_control's files have 0.03 and 0.05.
const LONGEST_TIMESTEP: f64 = 1.0;
/// Greatest difference between the norm of a quaternion and 1.
pub(crate) const NORM_TOLERANCE: f64 = 1e-2;
/// Bytes of the largest dataset of the longest clip: 31 quaternions per frame.
const LARGEST_READ: usize = 100_000 * 31 * 4 * size_of::<f64>();

/// The attribute of a clip that was made from others. It is this program's own; dm_control does not read it.
pub(crate) const MADE_FROM: &str = "made_from";
/// Greatest length of its text, bytes.
const LONGEST_ORIGIN: usize = 4096;

/// A dataset as the file stores it.
pub(crate) struct Stored {
    pub(crate) field: &'static str,
    /// Numbers per frame.
    pub(crate) width: usize,
    /// `(width, T)`, row by row.
    pub(crate) rows: Result<Vec<f64>, Error>,
}

/// Every dataset of a clip, with its numbers per frame.
pub(crate) fn widths(model: WalkerModel) -> [(&'static str, usize); 11] {
    let bodies = model.bodies();
    [
        ("position", 3),
        ("quaternion", 4),
        ("joints", 56),
        ("velocity", 3),
        ("angular_velocity", 3),
        ("joints_velocity", 56),
        ("center_of_mass", 3),
        ("end_effectors", 12),
        ("appendages", 15),
        ("body_positions", 3 * bodies),
        ("body_quaternions", 4 * bodies),
    ]
}

/// The attributes of a clip.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Header {
    pub(crate) steps: usize,
    pub(crate) dt: f64,
    pub(crate) model: WalkerModel,
}

/// Checks the text of [`MADE_FROM`]. Terminals show it, so no character of it may control them. The error says what is
/// allowed.
pub(crate) fn check_origin(text: &str) -> Result<(), String> {
    if text.len() <= LONGEST_ORIGIN && !text.chars().any(char::is_control) { Ok(()) } else { Err(allowed_origin()) }
}

fn allowed_origin() -> String {
    format!("must be a text of at most {LONGEST_ORIGIN} bytes without control characters")
}

/// An open file. Reading needs no lock, and reads from the disk only what it returns.
pub(crate) struct ClipFile {
    path: PathBuf,
    /// The file is read by position and not memory-mapped: if a mapped file is truncated, the process dies.
    storage: Arc<dyn Storage>,
    names: Vec<String>,
}

impl ClipFile {
    /// Opens the file and lists its clips.
    pub(crate) fn open(path: &Path) -> Result<Self, Error> {
        let unreadable = |reason| Error::Unreadable { path: path.into(), reason };
        let file = std::fs::File::open(path).map_err(unreadable)?;
        if file.metadata().map_err(unreadable)?.is_dir() {
            return Err(unreadable(std::io::ErrorKind::IsADirectory.into()));
        }
        let storage: Arc<dyn Storage> = Arc::new(guarded(path, "/", || FileStorage::from_file(file))?);
        let mut names = guarded(path, "/", || Ok(hdf5(&storage)?.root_group()?.member_names()?.0))?;
        names.sort_unstable();
        Ok(Self { path: path.into(), storage, names })
    }

    /// The names of all clips of the file, sorted.
    pub(crate) fn names(&self) -> &[String] {
        &self.names
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Reads the attributes of these clips, without their datasets: the header, and what the clip was made from.
    pub(crate) fn headers(&self, names: &[String]) -> Result<Vec<(Header, Option<String>)>, Error> {
        let root = self.root()?;
        names.iter().map(|name| Ok((self.header(&root, name)?, self.made_from(&root, name)?))).collect()
    }

    /// Reads the joint angles of a clip, rad, `[T][56]`.
    pub(crate) fn joints(&self, name: &str) -> Result<Vec<[f64; 56]>, Error> {
        let root = self.root()?;
        let header = self.header(&root, name)?;
        self.walker(&root, name, header)?.frames("joints")
    }

    /// Reads a whole clip.
    pub(crate) fn load(&self, name: &str) -> Result<Clip, Error> {
        let root = self.root()?;
        let header = self.header(&root, name)?;
        let made_from = self.made_from(&root, name)?;
        let walker = self.walker(&root, name, header)?;
        let bodies = header.model.bodies();
        let motion = Motion {
            position: walker.frames("position")?,
            quaternion: walker.frames("quaternion")?,
            joints: walker.frames("joints")?,
            velocity: walker.frames("velocity")?,
            angular_velocity: walker.frames("angular_velocity")?,
            joints_velocity: walker.frames("joints_velocity")?,
        };
        let features = Features {
            center_of_mass: walker.frames("center_of_mass")?,
            end_effectors: walker.frames("end_effectors")?,
            appendages: walker.frames("appendages")?,
            body_positions: walker.flat("body_positions", 3 * bodies)?,
            body_quaternions: walker.flat("body_quaternions", 4 * bodies)?,
        };
        walker.check_quaternions("quaternion", motion.quaternion.as_flattened())?;
        walker.check_quaternions("body_quaternions", &features.body_quaternions)?;
        let Header { dt, model, .. } = header;
        Ok(Clip { name: name.into(), made_from, model, dt, motion, features: Some(features) })
    }

    /// Reads a clip for the check for defects: the header and each dataset that can be read. Only the shape of a
    /// dataset is checked.
    pub(crate) fn stored(&self, name: &str) -> Result<(Header, Vec<Stored>), Error> {
        let root = self.root()?;
        let header = self.header(&root, name)?;
        let walker = self.walker(&root, name, header)?;
        let widths = widths(header.model);
        let read = |(field, width)| Stored { field, width, rows: walker.stored(field, width) };
        Ok((header, widths.into_iter().map(read).collect()))
    }

    fn root(&self) -> Result<Group, Error> {
        self.guarded("/", || hdf5(&self.storage)?.root_group())
    }

    fn walker<'a>(&'a self, root: &Group, name: &str, header: Header) -> Result<Walker<'a>, Error> {
        let item = format!("/{name}/walkers/walker_0");
        let group = self.guarded(&item, || root.group(name)?.group("walkers")?.group("walker_0"))?;
        Ok(Walker { file: self, item, group, header })
    }

    fn header(&self, root: &Group, name: &str) -> Result<Header, Error> {
        let clip = format!("/{name}");
        let group = self.guarded(&clip, || root.group(name))?;
        let dt = self.number(&group, &clip, "dt")?;
        if !(dt > 0.0 && dt <= LONGEST_TIMESTEP) {
            return Err(self
                .malformed(&format!("{clip}@dt"), format!("{dt} s is not a valid time step; dm_control uses 0.03 s")));
        }
        let steps = self.whole(&group, &clip, "num_steps")?;
        if !STEPS.contains(&steps) {
            let reason = format!("{steps} frames; a clip must have {} to {}", STEPS.start(), STEPS.end());
            return Err(self.malformed(&format!("{clip}@num_steps"), reason));
        }
        let item = format!("{clip}/walkers/walker_0");
        let walker = self.guarded(&item, || group.group("walkers")?.group("walker_0"))?;
        let model = self.whole(&walker, &item, "model")?;
        let model = WalkerModel::from_attribute(model).ok_or_else(|| {
            let reason = format!("unknown body {model}; expected 1 (CMU humanoid V2019) or 4 (CMU humanoid V2020)");
            self.malformed(&format!("{item}@model"), reason)
        })?;
        Ok(Header { steps: steps as usize, dt, model })
    }

    /// What a clip was made from, if its file says so.
    fn made_from(&self, root: &Group, name: &str) -> Result<Option<String>, Error> {
        let item = format!("/{name}@{MADE_FROM}");
        let attributes = self.guarded(&item, || root.group(name)?.attributes())?;
        let Some(found) = attributes.iter().find(|found| found.name == MADE_FROM) else {
            return Ok(None);
        };
        // Of an array, the reader may return the first text alone.
        let text = if found.shape.is_empty() { self.guarded(&item, || found.read_string()).ok() } else { None };
        match text.ok_or_else(allowed_origin).and_then(|text| check_origin(&text).map(|()| text)) {
            Ok(text) => Ok(Some(text).filter(|text| !text.is_empty())),
            Err(allowed) => Err(self.malformed(&item, format!("{allowed}; remove the attribute"))),
        }
    }

    fn number(&self, group: &Group, item: &str, attribute: &str) -> Result<f64, Error> {
        self.guarded(&format!("{item}@{attribute}"), || group.attribute(attribute)?.read_as_f64())
    }

    fn whole(&self, group: &Group, item: &str, attribute: &str) -> Result<u64, Error> {
        let number = self.number(group, item, attribute)?;
        // Every valid number here is far below 2^53, so f64 represents it exactly.
        if number.fract() == 0.0 && (0.0..=1e15).contains(&number) {
            Ok(number as u64)
        } else {
            Err(self.malformed(&format!("{item}@{attribute}"), format!("{number} is not a valid count")))
        }
    }

    fn guarded<T>(&self, item: &str, read: impl FnOnce() -> Result<T, Hdf5Error>) -> Result<T, Error> {
        guarded(&self.path, item, read)
    }

    fn malformed(&self, item: &str, reason: String) -> Error {
        Error::Malformed { path: self.path.clone(), item: item.into(), reason }
    }
}

/// The HDF5 reader never frees what it has parsed, so every call makes a new one.
fn hdf5(storage: &Arc<dyn Storage>) -> Result<Hdf5File, Hdf5Error> {
    let options = OpenOptions::default()
        .with_chunk_cache_bytes(0)
        .with_max_chunk_bytes(LARGEST_READ)
        .with_max_read_bytes(LARGEST_READ)
        .with_max_object_header_bytes(1 << 20);
    Hdf5File::from_storage_with_options(storage.clone(), options)
}

/// Runs the HDF5 reader. It reports damage as errors; if it panics on a damaged file, the panic becomes an error too.
fn guarded<T>(path: &Path, item: &str, read: impl FnOnce() -> Result<T, Hdf5Error>) -> Result<T, Error> {
    let reason = match catch_unwind(AssertUnwindSafe(read)) {
        Ok(Ok(value)) => return Ok(value),
        Ok(Err(error)) => match fault_of_the_disk(error) {
            Ok(reason) => return Err(Error::Unreadable { path: path.into(), reason }),
            Err(error) => reason(&error),
        },
        Err(_) => "damaged: the HDF5 reader failed; get the file again".into(),
    };
    Err(Error::Malformed { path: path.into(), item: item.into(), reason })
}

/// The operating system's error, if the disk is at fault, and not the file's content.
fn fault_of_the_disk(error: Hdf5Error) -> Result<std::io::Error, Hdf5Error> {
    use std::io::ErrorKind::{InvalidData, InvalidInput, UnexpectedEof};
    match error {
        Hdf5Error::Io(error) if !matches!(error.kind(), InvalidData | InvalidInput | UnexpectedEof) => Ok(error),
        Hdf5Error::Context { source, .. } => fault_of_the_disk(*source),
        error => Err(error),
    }
}

fn reason(error: &Hdf5Error) -> String {
    match error {
        Hdf5Error::Context { source, .. } => reason(source),
        Hdf5Error::GroupNotFound(_) | Hdf5Error::DatasetNotFound(_) | Hdf5Error::AttributeNotFound(_) => {
            "missing; every clip in dm_control's layout has it".into()
        }
        Hdf5Error::InvalidMagic => "not an HDF5 file".into(),
        error => error.to_string(),
    }
}

/// The group that holds a clip's datasets.
struct Walker<'a> {
    file: &'a ClipFile,
    item: String,
    group: Group,
    header: Header,
}

impl Walker<'_> {
    /// Reads a dataset `(N, T)` as T frames.
    fn frames<const N: usize>(&self, field: &str) -> Result<Vec<[f64; N]>, Error> {
        let rows = self.rows(field, N)?;
        let steps = self.header.steps;
        Ok((0..steps).map(|t| std::array::from_fn(|row| rows[row * steps + t])).collect())
    }

    /// Reads a dataset `(width, T)` as `[T, width]`, flattened.
    fn flat(&self, field: &str, width: usize) -> Result<Vec<f64>, Error> {
        let rows = self.rows(field, width)?;
        let steps = self.header.steps;
        Ok((0..steps).flat_map(|t| rows.iter().skip(t).step_by(steps).copied()).collect())
    }

    /// Reads a dataset `(width, T)` row by row. Checks its shape and that every number is finite.
    fn rows(&self, field: &str, width: usize) -> Result<Vec<f64>, Error> {
        let (rows, steps) = (self.stored(field, width)?, self.header.steps);
        match rows.iter().position(|number: &f64| !number.is_finite()) {
            None => Ok(rows),
            Some(place) => {
                let reason = format!("{} in row {}, frame {}", rows[place], place / steps, place % steps);
                let item = format!("{}/{field}", self.item);
                Err(self.file.malformed(&item, format!("{reason}; every number must be finite")))
            }
        }
    }

    /// Reads a dataset `(width, T)` row by row. Checks only its shape.
    fn stored(&self, field: &str, width: usize) -> Result<Vec<f64>, Error> {
        let item = format!("{}/{field}", self.item);
        let steps = self.header.steps;
        let dataset = self.file.guarded(&item, || self.group.dataset(field))?;
        if dataset.shape() != [width as u64, steps as u64] {
            let reason = format!(
                "has shape {:?}, expected [{width}, {steps}]: {width} numbers for each of num_steps frames of the {}",
                dataset.shape(),
                self.header.model
            );
            return Err(self.file.malformed(&item, reason));
        }
        self.file.guarded(&item, || {
            let mut rows = vec![0.0; width * steps];
            dataset.read_into::<f64>(&mut rows)?;
            Ok(rows)
        })
    }

    fn check_quaternions(&self, field: &str, quaternions: &[f64]) -> Result<(), Error> {
        let per_frame = quaternions.len() / 4 / self.header.steps;
        for (index, quaternion) in quaternions.chunks_exact(4).enumerate() {
            let norm = quaternion.iter().map(|part| part * part).sum::<f64>().sqrt();
            // The norm may overflow to infinity, but it cannot be NaN, because all numbers are finite.
            if (norm - 1.0).abs() >= NORM_TOLERANCE {
                let reason = format!("a quaternion of frame {} has norm {norm}, expected 1", index / per_frame);
                return Err(self.file.malformed(&format!("{}/{field}", self.item), reason));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    #[test]
    fn a_disk_that_fails_is_told_from_a_damaged_file() {
        let failed = |error: io::Error| {
            let context = Hdf5Error::Context { path: "walk".into(), source: Box::new(error.into()) };
            guarded::<()>(Path::new("walks.h5"), "/", || Err(context)).unwrap_err()
        };
        // EIO
        let disk = failed(io::Error::from_raw_os_error(5));
        assert!(matches!(disk, Error::Unreadable { .. }), "{disk}");
        let damage = failed(io::ErrorKind::UnexpectedEof.into());
        assert!(matches!(damage, Error::Malformed { .. }), "{damage}");
    }
}
