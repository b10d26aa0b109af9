//! Defects of clips, all of them at once.
//!
//! The limits are this project's choice: no source fixes them. They are wide enough for what people do (a run, a jump
//! from a height), also where it is scaled to the body's size.

mod stored;
mod tally;

use std::path::Path;

use serde::Serialize;

use crate::file::{ClipFile, Header};
use crate::{Error, WalkerModel};
use stored::Columns;

/// m: how deep a geom may sink into the floor, the plane z = 0.
pub const PENETRATION: f64 = 0.02;
/// m: what is higher above the floor than this, is in the air.
pub const AIRBORNE: f64 = 0.05;
/// s: longest flight; a person's centre of mass that rises by 0.8 m is back after that time.
pub const LONGEST_FLIGHT: f64 = 0.8;
/// rad: how far a joint may leave its range.
pub const JOINT_EXCESS: f64 = 0.01;
/// m/s: fastest root; sprinters reach 12, and clips are scaled by up to 1.4.
pub const ROOT_SPEED: f64 = 17.0;
/// rad/s: fastest turn of the root; skaters reach 30.
pub const ROOT_TURN: f64 = 35.0;
/// rad/s: fastest joint; kicks and throws of recorded clips reach 25.
pub const JOINT_SPEED: f64 = 40.0;

/// What is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Kind {
    /// A dataset or attribute is missing, mis-shaped or damaged; `detail` has the reason.
    Unreadable,
    /// NaN or infinity; `worst` is how many such numbers.
    NotFinite,
    /// A quaternion's norm is not 1; `worst` is how far off.
    QuaternionNorm,
    /// A joint leaves its range by more than [`JOINT_EXCESS`]; `worst` in rad.
    JointLimit,
    /// A geom is deeper in the floor than [`PENETRATION`]; `worst` in m.
    Penetration,
    /// The whole body is above [`AIRBORNE`] for longer than [`LONGEST_FLIGHT`]; `worst` is its height in m.
    Floating,
    /// The root or a joint moves faster from one frame to the next than [`ROOT_SPEED`], [`ROOT_TURN`] or
    /// [`JOINT_SPEED`]; `worst` in m/s or rad/s.
    Jump,
}

/// One defect of a clip.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Defect {
    /// What is wrong.
    pub kind: Kind,
    /// Where: a dataset, a joint, a geom, or `root`.
    pub item: String,
    /// In how many frames.
    pub frames: usize,
    /// The first of them.
    pub first_frame: usize,
    /// The worst of it, in the kind's unit; 0 for what has no size.
    pub worst: f64,
    /// In words.
    pub detail: String,
}

/// A clip, searched.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Checked {
    /// The clip's name.
    pub clip: String,
    /// How many frames it has; 0 when that cannot be read.
    pub frames: usize,
    /// Whether joints and floor were checked: only the V2020 body's are known.
    pub body_checked: bool,
    /// The lowest and the highest of the heights of the body's lowest point, m, where the body was checked.
    pub lowest_point: Option<[f64; 2]>,
    /// All defects, sorted by kind.
    pub defects: Vec<Defect>,
}

/// Searches every clip of a file, or those `chosen`.
///
/// # Errors
/// [`Error::Unreadable`], [`Error::Malformed`], [`Error::NoClips`] and [`Error::NoSuchClip`] when there is no clip to
/// be found; what is wrong with a clip is no error but a [`Defect`].
pub fn check(path: &Path, chosen: &[String]) -> Result<Vec<Checked>, Error> {
    let file = ClipFile::open(path)?;
    if file.names().is_empty() {
        return Err(Error::NoClips { path: path.into() });
    }
    let names = if chosen.is_empty() { file.names() } else { chosen };
    names
        .iter()
        .map(|name| match file.names().binary_search(name) {
            Ok(_) => Ok(check_clip(&file, name)),
            Err(_) => {
                let hint = crate::nearest::hint(name, file.names().iter().map(String::as_str));
                Err(Error::NoSuchClip { path: path.into(), name: name.clone(), hint })
            }
        })
        .collect()
}

fn check_clip(file: &ClipFile, name: &str) -> Checked {
    let (header, datasets) = match file.stored(name) {
        Ok(stored) => stored,
        Err(error) => {
            let defects = vec![unreadable("attributes", &error)];
            return Checked { clip: name.into(), frames: 0, body_checked: false, lowest_point: None, defects };
        }
    };
    let Header { steps, dt, model } = header;
    let (columns, mut defects) = Columns::search(datasets, steps);
    let body_checked = model == WalkerModel::Cmu2020;
    let mut lowest_point = None;
    if body_checked {
        columns.joint_limits(&mut defects);
        lowest_point = columns.floor(dt, &mut defects);
    }
    columns.jumps(dt, &mut defects);
    defects.sort_by_key(|defect| defect.kind);
    Checked { clip: name.into(), frames: steps, body_checked, lowest_point, defects }
}

fn unreadable(item: &str, error: &Error) -> Defect {
    let detail = match error {
        Error::Malformed { item, reason, .. } => format!("{item}: {reason}"),
        error => error.to_string(),
    };
    Defect { kind: Kind::Unreadable, item: item.into(), frames: 0, first_frame: 0, worst: 0.0, detail }
}
