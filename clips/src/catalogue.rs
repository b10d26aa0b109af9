//! The clips of an experiment: their list, and how to read each of them.

use std::{
    collections::BTreeSet,
    fmt,
    path::{Path, PathBuf},
};

use comic_experiment::{CONTROL_TIMESTEP, ClipSource, Experiment, TaskName};
use sha2::{Digest, Sha256};

use crate::builtin;
use crate::clip::Clip;
use crate::cut::{Cut, remove_others};
use crate::entry::Entry;
use crate::error::Error;
use crate::file::{ClipFile, Header};
use crate::humanoid::{WalkerModel, pose_to_action};
use crate::nearest::hint;
use crate::subsets::subset;

const BUILTIN: &str = "builtin:";

/// The opened clip sources of an experiment.
///
/// Opening reads only the attributes of the chosen clips, so it is cheap for files of any size. [`Catalogue::load`]
/// reads the motion of one clip.
pub struct Catalogue {
    entries: Vec<Entry>,
    /// For each entry, the index of its source in `sources`.
    source_of: Vec<usize>,
    sources: Vec<Source>,
}

/// A file that a catalogue reads. Actors fetch it and verify its hash.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Asset {
    /// The source as the experiment names it.
    pub source: String,
    /// The local path.
    pub path: PathBuf,
    /// SHA-256 of the whole file.
    pub sha256: [u8; 32],
    /// Length of the file, bytes.
    pub size: u64,
}

/// The name of a clip, its header, and what it was made from.
type Described = (String, (Header, Option<String>));

enum Source {
    Builtin,
    File { source: String, file: ClipFile },
}

impl Catalogue {
    /// Opens every source. The source of a file is its path. The clips are in the order of the sources; within one
    /// source they are sorted by name.
    ///
    /// # Errors
    /// [`Error`], for a source, subset, clip or sub-range that does not exist, and for a file whose attributes are not
    /// those of a clip.
    pub fn open(sources: &[ClipSource]) -> Result<Self, Error> {
        Self::open_with(sources, |source| Some(PathBuf::from(source)))
    }

    /// Like [`Catalogue::open`], but `locate` gives the local path of a source, or `None` if there is no local file. It
    /// is not called for built-in clips.
    ///
    /// # Errors
    /// As [`Catalogue::open`].
    pub fn open_with(sources: &[ClipSource], locate: impl Fn(&str) -> Option<PathBuf>) -> Result<Self, Error> {
        if sources.iter().all(|source| source.weight == 0.0) {
            return Err(Error::NoSources);
        }
        let mut catalogue = Self { entries: Vec::new(), source_of: Vec::new(), sources: Vec::new() };
        for source in sources {
            if !(source.weight >= 0.0 && source.weight.is_finite()) {
                return Err(Error::Weight { source_name: source.source.clone(), weight: source.weight });
            }
            match source.source.strip_prefix(BUILTIN) {
                Some(name) => catalogue.add_builtin(source, name)?,
                None => catalogue.add_file(source, locate(&source.source).as_deref())?,
            }
        }
        Ok(catalogue)
    }

    /// Without the clips that were made from others ([`Entry::made_from`]).
    ///
    /// # Errors
    /// [`Error::NoOriginals`] when no clip with a weight above 0 is left.
    pub fn originals(mut self) -> Result<Self, Error> {
        let kept = |entry: &Entry| entry.made_from.is_none();
        let mut of_entry = self.entries.iter();
        self.source_of.retain(|_| of_entry.next().is_some_and(kept));
        self.entries.retain(kept);
        if self.entries.iter().all(|entry| entry.weight == 0.0) { Err(Error::NoOriginals) } else { Ok(self) }
    }

    /// The clips of an evaluation. With `originals`, these are [`Catalogue::originals`] if a task of `experiment`
    /// follows clips. Other tasks have no reference, so they must not fail for lack of originals.
    ///
    /// # Errors
    /// As [`Catalogue::originals`].
    pub fn for_evaluation(self, experiment: &Experiment, originals: bool) -> Result<Self, Error> {
        if originals && follows_clips(experiment) { self.originals() } else { Ok(self) }
    }

    /// All clips. The index of a clip is its index in this slice.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Checks that the other tasks of joint training can be trained with these clips: a step of all tasks is equally long.
    ///
    /// # Errors
    /// [`Error::JointTimestep`].
    pub fn check_joint(&self, experiment: &Experiment) -> Result<(), Error> {
        if experiment.joint.is_empty() || !follows_clips(experiment) {
            return Ok(());
        }
        match self.entries.iter().find(|entry| !entry.steps_every(CONTROL_TIMESTEP)) {
            None => Ok(()),
            Some(entry) => {
                Err(Error::JointTimestep { name: entry.name.clone(), dt: entry.dt, expected: CONTROL_TIMESTEP })
            }
        }
    }

    /// Reads all frames of one clip. The frames in use are [`Entry::frames`].
    ///
    /// # Errors
    /// [`Error::Malformed`] for a dataset that is missing, has the wrong shape or is not finite;
    /// [`Error::NoSuchIndex`].
    pub fn load(&self, index: usize) -> Result<Clip, Error> {
        let (entry, source) = self.at(index)?;
        match source {
            Source::Builtin => builtin::load(&entry.name),
            Source::File { file, .. } => file.load(&entry.name),
        }
    }

    /// The files of the clips with their hashes, each file once. Built-in clips have no file. If at most half of the clips of a file
    /// are in use and there is a directory for `cuts`, a file with these clips alone is made there and takes its place. The files
    /// that earlier calls made there are removed first, so nobody may still fetch them.
    ///
    /// # Errors
    /// [`Error::Unreadable`]; with `cuts` also [`Error::Unwritable`], those of [`load`](Self::load), and those of
    /// [`ClipWriter::add`](crate::ClipWriter::add) for a clip that it does not write.
    pub fn assets(&self, cuts: Option<&Path>) -> Result<Vec<Asset>, Error> {
        let mut chosen: Vec<(Asset, Option<Cut>)> = Vec::new();
        for source in &self.sources {
            let Source::File { source, file } = source else { continue };
            if chosen.iter().any(|(whole, _)| whole.source == *source) {
                continue;
            }
            let whole = asset(source, file.path())?;
            let used = self.used(source);
            let directory = cuts.filter(|_| 2 * used.len() <= file.names().len());
            let cut = directory.map(|directory| Cut::of(file, &whole.sha256, used, directory));
            chosen.push((whole, cut));
        }
        if let Some(directory) = cuts {
            // The disk may be full of them.
            remove_others(directory, &chosen.iter().filter_map(|(_, cut)| cut.as_ref()).collect::<Vec<_>>());
        }
        let assets = chosen.into_iter().map(|(whole, cut)| {
            let Some(cut) = cut else { return Ok(whole) };
            cut.write()?;
            asset(&whole.source, cut.path())
        });
        assets.collect()
    }

    /// The names of the clips of a source that are in use, sorted. An experiment may name a source several times.
    fn used(&self, source: &str) -> Vec<String> {
        let is_of = |index: &usize| matches!(self.sources.get(*index), Some(Source::File { source: found, .. }) if found == source);
        let of_source = self.entries.iter().zip(&self.source_of).filter(|(_, index)| is_of(index));
        let names: BTreeSet<&String> = of_source.map(|(entry, _)| &entry.name).collect();
        names.into_iter().cloned().collect()
    }

    /// The servo action that aims at the mean pose of the clips, in `ctrl` order, each entry in [−1, 1]. It is the mean
    /// of [`pose_to_action`] over the frames in use of every clip, weighted by the weight of the clip. Only the joint
    /// angles are read from files.
    ///
    /// # Errors
    /// As [`Catalogue::load`].
    pub fn mean_action(&self) -> Result<[f64; 56], Error> {
        let (mut sum, mut weight) = ([0.0; 56], 0.0);
        for index in 0..self.entries.len() {
            let (entry, source) = self.at(index)?;
            let joints = match source {
                Source::Builtin => builtin::load(&entry.name)?.motion.joints,
                Source::File { file, .. } => file.joints(&entry.name)?,
            };
            for pose in joints.get(entry.frames()).unwrap_or_default() {
                weight += entry.weight;
                for (total, action) in sum.iter_mut().zip(pose_to_action(pose)) {
                    *total += entry.weight * action;
                }
            }
        }
        Ok(sum.map(|total| total / weight))
    }

    fn at(&self, index: usize) -> Result<(&Entry, &Source), Error> {
        let entry = self.entries.get(index);
        let source = self.source_of.get(index).and_then(|source| self.sources.get(*source));
        entry.zip(source).ok_or(Error::NoSuchIndex { index, clips: self.entries.len() })
    }

    fn add_builtin(&mut self, source: &ClipSource, name: &str) -> Result<(), Error> {
        if source.subset.is_some() || !source.ids.is_empty() {
            return Err(Error::BuiltinSelection { source_name: source.source.clone() });
        }
        let (own, steps, dt) = builtin::describe(name)?;
        self.add(source, Source::Builtin, vec![(own.into(), (Header { steps, dt, model: WalkerModel::Cmu2020 }, None))])
    }

    fn add_file(&mut self, source: &ClipSource, path: Option<&Path>) -> Result<(), Error> {
        let Some(path) = path.filter(|path| path.exists()) else {
            return Err(Error::NoSuchFile {
                source_name: source.source.clone(),
                hint: hint_for_file(&source.source, path),
            });
        };
        let file = ClipFile::open(path)?;
        let names = choose(source, &file)?;
        let headers = file.headers(&names)?;
        let clips = names.into_iter().zip(headers).collect();
        self.add(source, Source::File { source: source.source.clone(), file }, clips)
    }

    fn add(&mut self, source: &ClipSource, opened: Source, clips: Vec<Described>) -> Result<(), Error> {
        for (name, (Header { steps, dt, model }, made_from)) in clips {
            let (start_step, end_step, weight) = (source.start_step, source.end_step, source.weight);
            let entry = Entry { name, made_from, steps, dt, model, start_step, end_step, weight };
            entry.check_range()?;
            self.entries.push(entry);
            self.source_of.push(self.sources.len());
        }
        self.sources.push(opened);
        Ok(())
    }
}

impl fmt::Debug for Catalogue {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Catalogue").field("entries", &self.entries).finish_non_exhaustive()
    }
}

/// Whether a task of the experiment has the clips as its reference.
fn follows_clips(experiment: &Experiment) -> bool {
    experiment.tasks().iter().any(|(task, _)| *task == TaskName::Tracking)
}

/// The names of the clips in `file` that `source` selects, sorted.
fn choose(source: &ClipSource, file: &ClipFile) -> Result<Vec<String>, Error> {
    let has = |name: &String| file.names().binary_search(name).is_ok();
    let known = || file.names().iter().map(String::as_str);
    let mut names = match &source.subset {
        None => file.names().to_vec(),
        Some(name) => subset(name)?,
    };
    if names.is_empty() {
        return Err(Error::NoClips { path: file.path().into() });
    }
    if source.ids.is_empty() {
        let missing: Vec<&str> = names.iter().filter(|name| !has(name)).map(String::as_str).collect();
        return match &source.subset {
            Some(subset) if !missing.is_empty() => Err(Error::SubsetIncomplete {
                path: file.path().into(),
                subset: subset.clone(),
                missing: missing.len(),
                total: names.len(),
                first: first_few(&missing),
            }),
            _ => Ok(names),
        };
    }
    for name in &source.ids {
        if names.binary_search(name).is_ok() && has(name) {
            continue;
        }
        return Err(match &source.subset {
            Some(subset) if has(name) => Error::NotInSubset {
                source_name: source.source.clone(),
                name: name.clone(),
                subset: subset.clone(),
                hint: hint(name, names.iter().map(String::as_str)),
            },
            _ => {
                let near = hint(name, known());
                let all = || format!("; it has {}", first_few(&known().collect::<Vec<_>>()));
                let hint = if near.is_empty() { all() } else { near };
                Error::NoSuchClip { path: file.path().into(), name: name.clone(), hint }
            }
        });
    }
    names.clone_from(&source.ids);
    names.sort_unstable();
    match names.windows(2).find(|pair| pair[0] == pair[1]) {
        Some(pair) => Err(Error::ListedTwice { source_name: source.source.clone(), name: pair[0].clone() }),
        None => Ok(names),
    }
}

fn first_few(names: &[&str]) -> String {
    const FEW: usize = 5;
    let list = names.iter().take(FEW).copied().collect::<Vec<_>>().join(", ");
    if names.len() > FEW { format!("{list}, …") } else { list }
}

/// A hint for a source that does not exist: the built-in clip with this name, or similar HDF5 files in the same
/// directory.
fn hint_for_file(source: &str, path: Option<&Path>) -> String {
    if builtin::builtin_names().contains(&source) {
        return format!(" (did you mean `{BUILTIN}{source}`?)");
    }
    let Some(path) = path else {
        return "; there is no local copy of it".into();
    };
    let directory = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let files: Vec<String> = std::fs::read_dir(directory)
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| entry.file_name().into_string().ok())
        .filter(|name| [".h5", ".hdf5"].iter().any(|ending| name.ends_with(ending)))
        .collect();
    let wanted = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    match hint(&wanted, files.iter().map(String::as_str)) {
        near if near.is_empty() => "; name an HDF5 file in dm_control's layout, or builtin:NAME".into(),
        near => near,
    }
}

fn asset(source: &str, path: &Path) -> Result<Asset, Error> {
    let unreadable = |reason| Error::Unreadable { path: path.into(), reason };
    let mut file = std::fs::File::open(path).map_err(unreadable)?;
    let mut hasher = Sha256::new();
    let size = std::io::copy(&mut file, &mut hasher).map_err(unreadable)?;
    Ok(Asset { source: source.into(), path: path.into(), sha256: hasher.finalize().into(), size })
}
