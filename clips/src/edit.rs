//! Makes more clips of existing ones, for the CMU humanoid V2020.
//!
//! - [`mirror()`] exchanges left and right;
//! - [`speed()`] makes a clip faster or slower;
//! - [`join()`] takes the legs of one clip and the arms of another.
//!
//! A new clip has [`Clip::made_from`], a short text in the words of the command line. Parentheses are around a clip
//! that was made from others itself: `mirror (speed 0.8 CMU_007_01)`. Evaluations can leave such copies out.

mod join;
mod mirror;
mod speed;

use std::path::Path;

use comic_experiment::ClipSource;

pub use join::{Balance, join};
pub use mirror::{Fit, mirror};
pub use speed::{SPEEDS, speed};

use crate::catalogue::Catalogue;
use crate::clip::{Clip, Motion};
use crate::error::Error;
use crate::humanoid::{JOINT_RANGES, WalkerModel};
use crate::write::{ClipWriter, LONGEST_NAME};

/// Least number of frames: a velocity needs two.
const FEWEST: usize = 2;

/// Makes one new file. `edit` gets each clip of all `sources` and adds what it makes of it. With `with_originals` each
/// clip is written before its copies. Returns the number of written clips.
///
/// # Errors
/// The errors of [`Catalogue::open`], [`Catalogue::load`], [`ClipWriter`] and `edit`. With an error no file is written.
pub fn rewrite(
    sources: &[ClipSource],
    path: &Path,
    overwrite: bool,
    with_originals: bool,
    mut edit: impl FnMut(&Clip, &mut ClipWriter) -> Result<(), Error>,
) -> Result<usize, Error> {
    let catalogue = Catalogue::open(sources)?;
    let mut writer = ClipWriter::create(path, overwrite)?;
    for index in 0..catalogue.entries().len() {
        let clip = catalogue.load(index)?;
        if with_originals {
            writer.add(&clip)?;
        }
        edit(&clip, &mut writer)?;
    }
    let written = writer.clips();
    writer.finish()?;
    Ok(written)
}

/// Checks what every edit needs: the body V2020, a time step, two frames, and as many finite numbers in all fields.
fn check(clip: &Clip) -> Result<(), Error> {
    let name = || clip.name.clone();
    if clip.model != WalkerModel::Cmu2020 {
        return Err(Error::WrongModel { name: name(), has: clip.model, expected: WalkerModel::Cmu2020 });
    }
    let refused = |reason| Err(Error::Edit { name: name(), reason });
    if !(clip.dt > 0.0 && clip.dt.is_finite()) {
        return refused(format!("dt = {} s is not a time step", clip.dt));
    }
    let steps = clip.steps();
    if steps < FEWEST {
        return refused(format!("has {steps} frames; this needs at least {FEWEST}"));
    }
    let Motion { position, quaternion, joints, velocity, angular_velocity, joints_velocity } = &clip.motion;
    let lengths = [quaternion.len(), joints.len(), velocity.len(), angular_velocity.len(), joints_velocity.len()];
    if lengths.iter().any(|length| *length != steps) {
        return refused("its poses and velocities differ in their number of frames".into());
    }
    let fields = [position, velocity, angular_velocity].map(|field| field.as_flattened());
    let others = [quaternion.as_flattened(), joints.as_flattened(), joints_velocity.as_flattened()];
    if fields.into_iter().chain(others).flatten().any(|number| !number.is_finite()) {
        return refused("has a number that is NaN or infinite; see `comic-actor clips check`".into());
    }
    Ok(())
}

/// Checks the name of a new clip. It has the names of its sources in it, so it can become too long for a file.
fn named(name: String, sources: &[&Clip]) -> Result<String, Error> {
    let (Some(first), true) = (sources.first(), name.len() > LONGEST_NAME) else {
        return Ok(name);
    };
    let cause = match sources {
        [_] => "its name is too long",
        _ => "the names of the sources are too long together",
    };
    let length = name.len();
    let reason = format!(
        "{cause}: the name of the new clip would have {length} bytes, but {LONGEST_NAME} is the most; use clips with shorter \
         names"
    );
    Err(Error::Edit { name: first.name.clone(), reason })
}

/// The clip in the text of a copy's origin.
fn origin(clip: &Clip) -> String {
    clip.made_from.as_ref().map_or_else(|| clip.name.clone(), |made_from| format!("({made_from})"))
}

/// The angle clamped to the joint's range, rad. An angle that is outside by rounding alone is not changed.
fn clamped(angle: f64, joint: usize) -> f64 {
    const ROUNDING: f64 = 1e-9;
    let [low, high] = JOINT_RANGES[joint];
    let clamped = angle.clamp(low, high);
    if (angle - clamped).abs() > ROUNDING { clamped } else { angle }
}

/// Replaces the joint angles. The joint velocities change by the differences of the change of the angles: central ones,
/// and one-sided ones at both ends. So the velocity of an angle that does not change stays, bit for bit.
fn replace_joints(motion: &mut Motion, joints: Vec<[f64; 56]>, dt: f64) {
    let change: Vec<[f64; 56]> = joints
        .iter()
        .zip(&motion.joints)
        .map(|(new, old)| std::array::from_fn(|joint| new[joint] - old[joint]))
        .collect();
    let last = change.len().saturating_sub(1);
    for (frame, velocity) in motion.joints_velocity.iter_mut().enumerate() {
        let (before, after) = (frame.saturating_sub(1), (frame + 1).min(last));
        let seconds = (after - before).max(1) as f64 * dt;
        for (joint, velocity) in velocity.iter_mut().enumerate() {
            *velocity += (change[after][joint] - change[before][joint]) / seconds;
        }
    }
    motion.joints = joints;
}

/// Smooths changes in time, with the ends repeated. Five frames are 0.15 s.
fn smooth<const N: usize>(changes: &[[f64; N]]) -> Vec<[f64; N]> {
    const BINOMIAL: [f64; 5] = [1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0];
    let last = changes.len().saturating_sub(1);
    let neighbour = |frame: usize, tap: usize| &changes[(frame + tap).saturating_sub(2).min(last)];
    let mean = |frame: usize, i: usize| {
        BINOMIAL.iter().enumerate().map(|(tap, weight)| weight * neighbour(frame, tap)[i]).sum::<f64>()
    };
    (0..changes.len()).map(|frame| std::array::from_fn(|i| mean(frame, i))).collect()
}
