//! What can be wrong with a clip, a file of clips, or the choice of them.

use std::path::PathBuf;

use crate::humanoid::WalkerModel;

/// Every error of this crate; each message names file and item, and what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The source is no file, and no built-in clip.
    #[error("no clip file `{source_name}`{hint}")]
    NoSuchFile {
        /// As the experiment names it.
        source_name: String,
        /// The nearest names beside it.
        hint: String,
    },
    /// The file is there and cannot be read.
    #[error("{}: cannot be read: {reason}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The operating system's words.
        reason: std::io::Error,
    },
    /// Not HDF5, or damaged, or not in dm_control's layout.
    #[error("{}: {item}: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Group, attribute or dataset, as a path inside the file.
        item: String,
        /// What is wrong with it, and what it should be.
        reason: String,
    },
    /// A file without a single clip.
    #[error("{}: holds no clips; a clip is a group at the top of the file", path.display())]
    NoClips {
        /// The file.
        path: PathBuf,
    },
    /// The file has no clip of that name.
    #[error("{}: no clip `{name}`{hint}", path.display())]
    NoSuchClip {
        /// The file.
        path: PathBuf,
        /// The name asked for.
        name: String,
        /// The nearest names.
        hint: String,
    },
    /// `builtin:NAME` with an unknown NAME.
    #[error("no built-in clip `{name}`{hint}; built-in clips are {known}")]
    NoSuchBuiltin {
        /// The name asked for.
        name: String,
        /// The nearest names.
        hint: String,
        /// All of them.
        known: String,
    },
    /// An unknown subset.
    #[error("no subset `{name}`{hint}; subsets are {known}")]
    NoSuchSubset {
        /// The name asked for.
        name: String,
        /// The nearest names.
        hint: String,
        /// All of them.
        known: String,
    },
    /// The file lacks clips of the subset.
    #[error("{}: {missing} of the {total} clips of subset `{subset}` are missing: {first}; list the ids you have, or get the whole file", path.display())]
    SubsetIncomplete {
        /// The file.
        path: PathBuf,
        /// The subset.
        subset: String,
        /// How many are missing.
        missing: usize,
        /// How many the subset has.
        total: usize,
        /// The first few of them.
        first: String,
    },
    /// A clip that is named although the subset does not have it.
    #[error("{source_name}: clip `{name}` is not in subset `{subset}`{hint}; leave out the subset, or the clip")]
    NotInSubset {
        /// The source.
        source_name: String,
        /// The clip.
        name: String,
        /// The subset.
        subset: String,
        /// The nearest names of the subset.
        hint: String,
    },
    /// The same clip twice in one source.
    #[error("{source_name}: clip `{name}` is listed twice; use weight to have more of it")]
    ListedTwice {
        /// The source.
        source_name: String,
        /// The clip.
        name: String,
    },
    /// `subset` or `ids` with a built-in clip.
    #[error("{source_name}: a built-in clip is a single clip, so it takes neither subset nor ids")]
    BuiltinSelection {
        /// The source.
        source_name: String,
    },
    /// A sub-range that the clip does not have.
    #[error("clip `{name}`: {field} = {value}: must be {allowed}; the clip has {steps} frames")]
    Range {
        /// The clip.
        name: String,
        /// `start_step` or `end_step`.
        field: &'static str,
        /// As given.
        value: usize,
        /// What it may be.
        allowed: String,
        /// T.
        steps: usize,
    },
    /// A weight that is none.
    #[error("{source_name}: weight = {weight}: must be a finite number, 0 or more")]
    Weight {
        /// The source.
        source_name: String,
        /// As given.
        weight: f64,
    },
    /// A clip for another body.
    #[error("clip `{name}` was made for the {has} ({} bodies), this is the {expected} ({} bodies); use clips of that body", has.bodies(), expected.bodies())]
    WrongModel {
        /// The clip.
        name: String,
        /// Its body.
        has: WalkerModel,
        /// The body in use.
        expected: WalkerModel,
    },
    /// A clip whose frames are not one control step apart.
    #[error(
        "clip `{name}` has dt = {dt} s, expected {expected} s; a control step is one frame, so all clips of an experiment have the same dt"
    )]
    WrongTimestep {
        /// The clip.
        name: String,
        /// Its dt, s.
        dt: f64,
        /// The control timestep, s.
        expected: f64,
    },
    /// No frame of the clip can be a start.
    #[error(
        "clip `{name}` is too short: its frames {first} to {last} are {frames}, but looking {look_ahead} frames ahead for at least {min_steps} steps needs {needed}; lower tracking.reference_steps or tracking.min_steps, or leave it out"
    )]
    TooShort {
        /// The clip.
        name: String,
        /// First frame that may be a start.
        first: usize,
        /// Last frame that counts for starts.
        last: usize,
        /// How many that are.
        frames: usize,
        /// The farthest reference frame.
        look_ahead: usize,
        /// Steps a started episode must at least be able to last.
        min_steps: usize,
        /// How many frames it would take.
        needed: usize,
    },
    /// A clip's index beyond the catalogue.
    #[error("no clip with index {index}; the experiment has {clips} clips")]
    NoSuchIndex {
        /// The index.
        index: usize,
        /// How many there are.
        clips: usize,
    },
    /// A line of an ASF or AMC file.
    #[error("{}:{line}: {reason}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// Counted from 1.
        line: usize,
        /// What is wrong with it, and what it should be.
        reason: String,
    },
    /// A recording, skeleton or manifest that cannot be imported.
    #[error("{}: {reason}", path.display())]
    Recording {
        /// The file.
        path: PathBuf,
        /// Why not.
        reason: String,
    },
    /// A constant of an import that is out of bounds.
    #[error("{what} {value}: expected {expected}")]
    Constant {
        /// Which.
        what: &'static str,
        /// As given.
        value: String,
        /// What it may be.
        expected: &'static str,
    },
    /// The output is there already.
    #[error("{} exists; add --force to replace it, or name another file", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// A file cannot be written.
    #[error("{}: cannot be written: {reason}", path.display())]
    Unwritable {
        /// The file.
        path: PathBuf,
        /// Why not.
        reason: String,
    },
    /// Two clips of one name in one file.
    #[error("clip `{name}` comes twice, and a file has each name once; choose clips with FILE.h5#CLIP,CLIP")]
    NameTaken {
        /// The name.
        name: String,
    },
    /// A name that no clip can have.
    #[error("`{name}` is no name for a clip: it takes 1 to 200 characters, none of them `/` or `.` or a space")]
    Name {
        /// The name.
        name: String,
    },
    /// An experiment without a clip source, or with weight 0 for each.
    #[error("clips: no source with a weight above 0; name a file or a built-in clip")]
    NoSources,
}
