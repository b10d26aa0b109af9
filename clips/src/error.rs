//! The errors of clips, of files of clips, and of the selection of clips.

use std::path::PathBuf;

use crate::clip::STEPS;
use crate::humanoid::WalkerModel;

/// Every error of this crate. Each message names the file and the item, and says what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The source is neither a file nor a built-in clip.
    #[error("no clip file `{source_name}`{hint}")]
    NoSuchFile {
        /// The source as the experiment names it.
        source_name: String,
        /// Similar names in the same directory.
        hint: String,
    },
    /// The file exists and cannot be read.
    #[error("{}: cannot be read: {reason}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The operating system's error.
        reason: std::io::Error,
    },
    /// The file is not HDF5, is damaged, or is not in dm_control's layout.
    #[error("{}: {item}: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Group, attribute or dataset, as a path inside the file.
        item: String,
        /// What is wrong, and what is expected.
        reason: String,
    },
    /// The file has no clip.
    #[error("{}: has no clips; a clip is a group at the top of the file", path.display())]
    NoClips {
        /// The file.
        path: PathBuf,
    },
    /// The file has no clip with this name.
    #[error("{}: no clip `{name}`{hint}", path.display())]
    NoSuchClip {
        /// The file.
        path: PathBuf,
        /// The requested name.
        name: String,
        /// Similar names.
        hint: String,
    },
    /// `builtin:NAME` with an unknown NAME.
    #[error("no built-in clip `{name}`{hint}; built-in clips are {known}")]
    NoSuchBuiltin {
        /// The requested name.
        name: String,
        /// Similar names.
        hint: String,
        /// All known names.
        known: String,
    },
    /// No subset has this name.
    #[error("no subset `{name}`{hint}; subsets are {known}")]
    NoSuchSubset {
        /// The requested name.
        name: String,
        /// Similar names.
        hint: String,
        /// All known names.
        known: String,
    },
    /// The file does not have all clips of the subset.
    #[error("{}: {missing} of the {total} clips of subset `{subset}` are missing: {first}; list the ids you have, or get the whole file", path.display())]
    SubsetIncomplete {
        /// The file.
        path: PathBuf,
        /// The subset.
        subset: String,
        /// Number of missing clips.
        missing: usize,
        /// Number of clips in the subset.
        total: usize,
        /// The first missing names.
        first: String,
    },
    /// A listed clip is not in the subset.
    #[error("{source_name}: clip `{name}` is not in subset `{subset}`{hint}; leave out the subset, or the clip")]
    NotInSubset {
        /// The source.
        source_name: String,
        /// The clip.
        name: String,
        /// The subset.
        subset: String,
        /// Similar names in the subset.
        hint: String,
    },
    /// A source lists the same clip twice.
    #[error("{source_name}: clip `{name}` is listed twice; set weight to use it more often")]
    ListedTwice {
        /// The source.
        source_name: String,
        /// The clip.
        name: String,
    },
    /// A built-in clip has `subset` or `ids`.
    #[error("{source_name}: a built-in clip is a single clip and has neither subset nor ids")]
    BuiltinSelection {
        /// The source.
        source_name: String,
    },
    /// A sub-range is not within the clip.
    #[error("clip `{name}`: {field} = {value}: must be {allowed}; the clip has {steps} frames")]
    Range {
        /// The clip.
        name: String,
        /// `start_step` or `end_step`.
        field: &'static str,
        /// The given value.
        value: usize,
        /// The allowed values.
        allowed: String,
        /// T, the number of frames.
        steps: usize,
    },
    /// A weight is negative or not finite.
    #[error("{source_name}: weight = {weight}: must be a finite number, 0 or more")]
    Weight {
        /// The source.
        source_name: String,
        /// The given value.
        weight: f64,
    },
    /// The clip was made for another body.
    #[error("clip `{name}` was made for the {has} ({} bodies), not for the {expected} ({} bodies); use clips of that body", has.bodies(), expected.bodies())]
    WrongModel {
        /// The clip.
        name: String,
        /// Its body.
        has: WalkerModel,
        /// The body in use.
        expected: WalkerModel,
    },
    /// The time step of the clip is not the control time step.
    #[error(
        "clip `{name}` has dt = {dt} s, expected {expected} s; a control step is one frame, so all clips of an experiment have the same dt"
    )]
    WrongTimestep {
        /// The clip.
        name: String,
        /// Time step of the clip, s.
        dt: f64,
        /// The control time step, s.
        expected: f64,
    },
    /// The time step of the clip is not that of the other tasks of joint training.
    #[error(
        "clip `{name}` has dt = {dt} s, but a step of the other tasks in `joint` takes {expected} s, and one policy acts in all \
         of them; leave the clip out of `clips`, or train on it without `joint`"
    )]
    JointTimestep {
        /// The clip.
        name: String,
        /// Time step of the clip, s.
        dt: f64,
        /// The control time step of the other tasks, s.
        expected: f64,
    },
    /// No frame of the clip can be the start of an episode.
    #[error(
        "clip `{name}` is too short: frames {first} to {last} are {frames} frames, but {min_steps} steps that look {look_ahead} frames ahead need {needed}; lower tracking.reference_steps or tracking.min_steps, or remove the clip"
    )]
    TooShort {
        /// The clip.
        name: String,
        /// First frame that may be a start.
        first: usize,
        /// Last frame that may be a start.
        last: usize,
        /// Number of these frames.
        frames: usize,
        /// Distance to the farthest reference, frames.
        look_ahead: usize,
        /// Least number of steps that an episode must be able to last.
        min_steps: usize,
        /// Number of frames that are needed.
        needed: usize,
    },
    /// The catalogue has no clip with this index.
    #[error("no clip with index {index}; the experiment has {clips} clips")]
    NoSuchIndex {
        /// The index.
        index: usize,
        /// Number of clips.
        clips: usize,
    },
    /// A line of an ASF or AMC file is invalid.
    #[error("{}:{line}: {reason}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// Number of the line, from 1.
        line: usize,
        /// What is wrong, and what is expected.
        reason: String,
    },
    /// A recording, skeleton or manifest cannot be imported.
    #[error("{}: {reason}", path.display())]
    Recording {
        /// The file.
        path: PathBuf,
        /// The reason.
        reason: String,
    },
    /// A constant of an import is out of bounds.
    #[error("{what} {value}: expected {expected}")]
    Constant {
        /// Name of the constant.
        what: &'static str,
        /// The given value.
        value: String,
        /// The allowed values.
        expected: &'static str,
    },
    /// No clip can be made of this one, or this one cannot be written.
    #[error("clip `{name}`: {reason}")]
    Edit {
        /// The clip.
        name: String,
        /// What is wrong, and what is expected.
        reason: String,
    },
    /// A clip has no frames, or more than this program reads.
    #[error(
        "clip `{name}` has {steps} frames; a clip in a file must have {} to {}, so split a longer motion",
        STEPS.start(),
        STEPS.end()
    )]
    Length {
        /// The clip.
        name: String,
        /// T, the number of frames.
        steps: usize,
    },
    /// The output file exists already.
    #[error("{} exists; add --force to replace it, or name another file", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The file cannot be written.
    #[error("{}: cannot be written: {reason}", path.display())]
    Unwritable {
        /// The file.
        path: PathBuf,
        /// The reason.
        reason: String,
    },
    /// A file has two clips with the same name.
    #[error("clip `{name}` occurs twice, but names in a file are unique; select clips with FILE.h5#CLIP,CLIP")]
    NameTaken {
        /// The name.
        name: String,
    },
    /// The name is not allowed for a clip.
    #[error("`{name}` is not a valid name of a clip: a name has 1 to 200 bytes, without `/`, `.` and spaces")]
    Name {
        /// The name.
        name: String,
    },
    /// Every clip with a weight above 0 was made from others.
    #[error(
        "every clip with a weight above 0 was made from others; leave out --originals, or name clips that were not"
    )]
    NoOriginals,
    /// The experiment has no clip source with a weight above 0.
    #[error("clips: no source has a weight above 0; name a file or a built-in clip")]
    NoSources,
}
