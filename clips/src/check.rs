//! A search for all defects of clips.
//!
//! The limits are this project's choice; no publication defines them. They allow what people do (a run, a jump from a
//! height), also after scaling to the size of the body. "The real clips" in the text of a limit are 24 recordings of the
//! CMU database, 5,418 frames: walks, runs, jumps, kicks, squats and bends. None of them has a defect.
//!
//! Some descriptions begin with "cannot be followed". In those frames the clip breaks the laws of physics, or asks for more
//! than the body has: no policy can follow it there, however long it is trained. Change the clip or leave it out. A sound
//! clip can still be hard to learn.

mod balance;
mod defect;
mod flight;
mod floor;
mod pose;
mod stored;
mod tally;

use std::path::Path;

use serde::Serialize;

use crate::error::Error;
use crate::file::{ClipFile, Header};
use crate::humanoid::WalkerModel;
pub use defect::{
    AIRBORNE, DEEP_PENETRATION, Defect, GRAVITY, HIGHEST_JUMP, JOINT_EXCESS, JOINT_SPEED, Kind, LEAST_FALL,
    LONGEST_FLIGHT, MOST_FALL, MOST_JUMPS, OVERHANG, PENETRATION, ROOT_SPEED, ROOT_TURN, SHORTEST_FLIGHT, STILL,
    STILL_TIME,
};

use defect::unreadable;
use stored::Columns;

/// The result for one clip.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Checked {
    /// The clip's name.
    pub clip: String,
    /// Number of frames; 0 if it cannot be read.
    pub frames: usize,
    /// Whether joints, floor, flights and balance were checked. That is possible only for the V2020 body.
    pub body_checked: bool,
    /// Minimum and maximum, over all frames, of the height of the body's lowest point, m. `None` if the body was not
    /// checked.
    pub lowest_point: Option<[f64; 2]>,
    /// All defects, sorted by kind.
    pub defects: Vec<Defect>,
}

/// Checks the `chosen` clips of a file; all clips if `chosen` is empty.
///
/// # Errors
/// [`Error::Unreadable`], [`Error::Malformed`], [`Error::NoClips`] and [`Error::NoSuchClip`], if a clip cannot be
/// found. A clip that is damaged is not an error: it has a [`Defect`].
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
        let poses = columns.poses();
        lowest_point = floor::lowest_point(&poses);
        defects.extend(floor::penetration(&poses));
        flight::flights(&poses, dt, &mut defects);
        defects.extend(balance::unbalanced(&poses, dt));
    }
    columns.jumps(dt, &mut defects);
    defects.sort_by_key(|defect| defect.kind);
    Checked { clip: name.into(), frames: steps, body_checked, lowest_point, defects }
}
