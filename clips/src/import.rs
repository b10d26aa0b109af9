//! Makes clips from CMU's own recordings: ASF (a skeleton) and AMC (its angles, 120 frames per second).
//!
//! # Layout
//! The modules in the order of their work:
//! - `asf` and `amc` read the files;
//! - `sole` corrects the ankles by the pitch of the subject's soles;
//! - `angles` moves angles into the body's ranges, and `arms` fits the arms that are outside their ranges;
//! - `resample` smooths, and goes from 1/120 s to 0.03 s per frame;
//! - `floor` puts the body on the floor;
//! - `velocity` computes velocities from the poses, and [`Features::of`] the features.

mod amc;
mod angles;
pub(crate) mod arms;
mod asf;
mod constants;
mod floor;
mod lines;
mod manifest;
mod resample;
mod skeleton;
mod sole;
mod velocity;

use std::f64::consts::FRAC_PI_2;
use std::ops::Range;

pub use constants::{Constants, Floor, Take, UsedConstants};
pub use manifest::read_manifest;

pub(crate) use angles::THUMBS;
pub(crate) use floor::Poses;
pub(crate) use sole::SOLE;
pub(crate) use velocity::motion;

use crate::clip::{Clip, Features};
use crate::error::Error;
use crate::humanoid::WalkerModel;
use crate::spatial::{Quaternion, Vector, about, multiply};
use amc::Recording;
use asf::Skeleton;

/// Control time step of dm_control for the CMU clips, s.
pub(crate) const DT: f64 = 0.03;
/// Recorded frames beyond the frames in use that the smoothing reads, on each side.
const SMOOTHING_REACH: usize = 2;

/// Converts a recording to a clip of the CMU humanoid V2020 with 0.03 s per frame. Also returns the constants that were
/// used.
///
/// Velocities are central differences, because the task compares them with instantaneous velocities. Lengths are scaled
/// by the ratio of the body's leg to the subject's leg; the time is not scaled.
///
/// # Errors
/// [`Error::Unreadable`], [`Error::Line`] and [`Error::Recording`] for files that are not CMU's; [`Error::Constant`].
pub fn import(take: &Take) -> Result<(Clip, UsedConstants), Error> {
    let constants = &take.constants;
    constants.check()?;
    let skeleton = Skeleton::read(&take.asf)?;
    let recording = Recording::read(&take.amc)?;
    let frames = window(take, recording.root.len())?;
    let mut notes = Vec::new();
    if let Some(gap) = recording.gap {
        notes.push(format!("frame {gap} of {} does not follow the previous frame", take.amc.display()));
    }

    let scale = constants.scale.unwrap_or(skeleton.scale);
    let root = Root::of(&recording, skeleton.meters * scale);
    let mut recorded: Vec<[f64; 56]> = recording.angles.iter().map(|angles| angles.map(f64::to_radians)).collect();
    let sole_degrees = match constants.sole_degrees {
        Some(degrees) => degrees,
        None => find_soles(&root, &recorded, &frames, &mut notes),
    };
    recorded.iter_mut().for_each(|angles| sole::correct(angles, sole_degrees));

    let arm_regularisation = constants.arm_regularisation.unwrap_or(arms::REGULARISATION);
    let mut fitted = angles::fit(&recorded, &frames);
    let reach = frames.start.saturating_sub(SMOOTHING_REACH)..(frames.end + SMOOTHING_REACH + 1).min(recorded.len());
    for (free, joints) in fitted.free[reach.clone()].iter().zip(&mut fitted.joints[reach]) {
        arms::fit(free, joints, arm_regularisation);
    }

    let mut poses = Poses {
        position: resample::resample(&root.position, &frames),
        quaternion: resample::resample_rotations(&root.quaternion, &frames),
        joints: resample::resample(&fitted.joints, &frames),
    };
    poses.start_at_origin();
    let floor = poses.set_on_floor(constants.floor);
    let motion = velocity::motion(poses, DT);
    let features = Features::of(&motion);
    let name = take.name.clone();
    let clip = Clip { name, made_from: None, model: WalkerModel::Cmu2020, dt: DT, motion, features: Some(features) };
    Ok((clip, UsedConstants { scale, sole_degrees, floor, arm_regularisation, frames, notes }))
}

/// The recorded frames in use. They must give two poses, because a velocity needs two.
fn window(take: &Take, recorded: usize) -> Result<Range<usize>, Error> {
    let Range { start, end } = take.constants.frames.clone().unwrap_or(0..recorded);
    let frames = start..end.min(recorded);
    if resample::poses(&frames) < 2 {
        let reason = format!(
            "frames {start}..{end} of {recorded} are too few: a clip needs at least 5 frames; frames are counted from 0"
        );
        return Err(Error::Recording { path: take.amc.clone(), reason });
    }
    Ok(frames)
}

/// The root in every recorded frame: position (m) and orientation in the world frame, z up.
struct Root {
    position: Vec<Vector>,
    quaternion: Vec<Quaternion>,
}

impl Root {
    /// Converts from the file's frame, in which y is up. One unit of the file is `meters` m.
    fn of(recording: &Recording, meters: f64) -> Self {
        let turn = |[_, _, _, x, y, z]: &[f64; 6]| {
            let [x, y, z] = [x, y, z].map(|degrees| degrees.to_radians());
            let recorded = multiply(about(2, z), multiply(about(1, y), about(0, x)));
            multiply(about(0, FRAC_PI_2), recorded)
        };
        Self {
            position: recording.root.iter().map(|[x, y, z, ..]| [meters * x, -meters * z, meters * y]).collect(),
            quaternion: recording.root.iter().map(turn).collect(),
        }
    }
}

/// The sole pitch in the frames in use, degrees, left and right. Adds a note for a foot without one.
fn find_soles(root: &Root, recorded: &[[f64; 56]], frames: &Range<usize>, notes: &mut Vec<String>) -> [f64; 2] {
    let fitted = angles::fit(recorded, frames);
    let poses = frames.clone().map(|frame| (root.position[frame], root.quaternion[frame], fitted.joints[frame]));
    let found = sole::find(poses);
    for (side, _) in ["left", "right"].iter().zip(found).filter(|(_, found)| found.is_none()) {
        notes.push(format!(
            "the {side} foot never stands, so its sole pitch is not corrected; give --sole-deg if the sole is not level"
        ));
    }
    found.map(Option::unwrap_or_default)
}

impl Poses {
    /// Moves all poses so that the first one is at x = y = 0.
    pub(crate) fn start_at_origin(&mut self) {
        let [x, y, _] = self.position.first().copied().unwrap_or_default();
        for position in &mut self.position {
            position[0] -= x;
            position[1] -= y;
        }
    }
}
