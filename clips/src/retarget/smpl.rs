//! SMPL recordings in the layout of AMASS: the angles of the joints of a body model, as a NumPy .npz file.
//!
//! The file has the rotations of SMPL's joints, but not the lengths of its bones: those come from a body model with a
//! licence of its own. This reader does not need that model. Its bones have average human proportions, and the stature
//! comes from the motion.

mod body;
mod stature;

use std::path::Path;

use super::npz::Npz;
use super::recorded::{Recorded, RecordedPose};
use crate::error::Error;
use crate::spatial::{IDENTITY, Quaternion, Vector, about_vector, norm, scale};

/// Joints that all SMPL models share. The joints of hands and face follow them.
const JOINTS: usize = 22;
/// Numbers of a frame that are read: an axis times an angle for each joint.
const NUMBERS: usize = 3 * JOINTS;
/// Greatest number of frames, as for recordings of CMU.
const MOST_FRAMES: usize = 360_000;
/// The keys that the frame rate has in the versions of AMASS, Hz.
const RATES: [&str; 3] = ["mocap_framerate", "mocap_frame_rate", "fps"];
/// Frame rates that are accepted, Hz.
const HERTZ: std::ops::RangeInclusive<f64> = 1.0..=10_000.0;

/// Reads a recording of AMASS (SMPL, SMPL-H or SMPL-X). Lengths are in m. Also returns notes about what was assumed.
///
/// Reads `poses` (`[T, 66 or more]`, axis times angle, rad), or `root_orient` (`[T, 3]`) and `pose_body`
/// (`[T, 63 or more]`); `trans` (`[T, 3]`, m); and `mocap_framerate` or `mocap_frame_rate` (Hz). In the rest pose, which
/// is a T, y is up, the body faces z, and x points to its left; the root's rotation turns that into the world.
///
/// # Errors
/// [`Error::Unreadable`]; [`Error::Recording`] if the file has another layout, or numbers that are not finite.
pub fn read_smpl(path: &Path) -> Result<(Recorded, Vec<String>), Error> {
    let mut file = Npz::open(path)?;
    let poses = poses(&mut file)?;
    let Some(positions) = file.rows::<3>("trans", MOST_FRAMES)? else { return Err(missing(&file, "trans")) };
    if positions.len() != poses.len() {
        let reason = format!("has {} frames, but the poses have {}", positions.len(), poses.len());
        return Err(file.error("trans", reason));
    }
    let frame_seconds = 1.0 / rate(&mut file)?;
    let rotations = poses.iter().map(|numbers| numbers.as_chunks().0.iter().map(|turn| rotation(*turn)).collect());
    let frames = positions.into_iter().zip(rotations);
    let frames = frames.map(|(position, rotations)| RecordedPose { position, rotations }).collect();
    let bones = body::bones(1.0);
    let mut recorded = Recorded { path: path.into(), bones, rest_in_world: false, frame_seconds, frames };

    let mut notes = Vec::new();
    let found = stature::find(&recorded);
    let stature = *found.as_ref().unwrap_or(&stature::AVERAGE);
    recorded.bones = body::bones(stature);
    notes.push(match found {
        Ok(_) => format!("stature {stature:.2} m, at which the feet stay on one floor; proportions are average"),
        Err(reason) => format!("stature {stature:.2} m and proportions are assumed: {reason}"),
    });
    let ignored: Vec<&str> = ["betas", "gender"].into_iter().filter(|key| file.has(key)).collect();
    if !ignored.is_empty() {
        notes.push(format!("{} not used: only SMPL's body model could interpret it", ignored.join(" and ")));
    }
    Ok((recorded, notes))
}

/// Axis times angle of each joint, rad, frame by frame.
fn poses(file: &mut Npz) -> Result<Vec<[f64; NUMBERS]>, Error> {
    if let Some(poses) = file.rows("poses", MOST_FRAMES)? {
        return Ok(poses);
    }
    let root = file.rows::<3>("root_orient", MOST_FRAMES)?;
    let body = file.rows::<{ NUMBERS - 3 }>("pose_body", MOST_FRAMES)?;
    let (Some(root), Some(body)) = (root, body) else {
        return Err(missing(file, "poses` or `root_orient` and `pose_body"));
    };
    if root.len() != body.len() {
        let reason = format!("has {} frames, but `root_orient` has {}", body.len(), root.len());
        return Err(file.error("pose_body", reason));
    }
    let joined = root.iter().zip(&body).map(|(root, body)| {
        let mut numbers = [0.0; NUMBERS];
        for (number, read) in numbers.iter_mut().zip(root.iter().chain(body)) {
            *number = *read;
        }
        numbers
    });
    Ok(joined.collect())
}

/// The frame rate, Hz.
fn rate(file: &mut Npz) -> Result<f64, Error> {
    for key in RATES {
        match file.scalar(key)? {
            Some(rate) if HERTZ.contains(&rate) => return Ok(rate),
            Some(rate) => {
                let reason = format!("is {rate}, expected frames per second from {} to {}", HERTZ.start(), HERTZ.end());
                return Err(file.error(key, reason));
            }
            None => {}
        }
    }
    Err(missing(file, &RATES.join("` or `")))
}

fn missing(file: &Npz, key: &str) -> Error {
    let keys = file.keys();
    let has = if keys.is_empty() { "no arrays".into() } else { keys.join(", ") };
    file.error(key, format!("not in the file, which has {has}; a motion of AMASS has poses, trans and mocap_framerate"))
}

/// A rotation from axis times angle, rad.
fn rotation(turn: Vector) -> Quaternion {
    let angle = norm(&turn);
    // The direction of a shorter vector is rounding.
    if angle < 1e-12 { IDENTITY } else { about_vector(scale(1.0 / angle, turn), angle) }
}
