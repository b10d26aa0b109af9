//! BVH files: a skeleton and its motion as text, written by most programs of motion capture.
//!
//! The format has no standard. This reader follows the usual programs: a position channel replaces the joint's offset
//! on that axis; rotations are intrinsic, in the order of the channels, in degrees.

mod hierarchy;
mod motion;
mod text;

use std::path::Path;

use super::recorded::{Recorded, RecordedBone, RecordedPose};
use crate::error::Error;
use crate::spatial::{Vector, add, multiply, norm, rotated, subtract};
use hierarchy::Joint;
use motion::Motion;
use text::Text;

/// Greatest distance of a joint from its median place, as a share of the bone's length, without a note.
const MOVES: f64 = 0.01;
/// The same for a bone without length, in the file's unit: what rounding to three digits gives.
const ROUNDING: f64 = 1e-3;

/// Reads a BVH file. Also returns notes about what could not be kept.
///
/// The skeleton of a [`Recorded`] is rigid, so a joint other than the root that has position channels gets their median
/// over the frames as its offset. A root whose only child has position channels ("Reference" with "Hips") is merged with it.
///
/// # Errors
/// [`Error::Unreadable`]; [`Error::Line`] for a line that is invalid, and for a file that is incomplete or too large.
pub fn read_bvh(path: &Path) -> Result<(Recorded, Vec<String>), Error> {
    let mut text = Text::open(path)?;
    let mut joints = hierarchy::read(&mut text)?;
    let mut motion = motion::read(&mut text, &joints)?;
    let mut notes = Vec::new();
    while let Some(note) = merge_carrier(&mut joints, &mut motion) {
        notes.push(note);
    }
    // What is merged may turn the person upright in every frame, as from z up to y up.
    let rest_in_world = notes.is_empty();
    notes.extend(settle(&mut joints, &motion.places));
    let root = |frame: usize| {
        let fixed = joints.first().map(|joint| joint.offset).unwrap_or_default();
        motion.places.first().and_then(|places| places.get(frame)).copied().unwrap_or(fixed)
    };
    let positions: Vec<Vector> = (0..motion.rotations.len()).map(root).collect();
    let frames = positions.into_iter().zip(motion.rotations);
    let recorded = Recorded {
        path: text.path().into(),
        rest_in_world,
        frame_seconds: motion.frame_seconds,
        frames: frames.map(|(position, rotations)| RecordedPose { position, rotations }).collect(),
        bones: joints.into_iter().map(RecordedBone::from).collect(),
    };
    Ok((recorded, notes))
}

impl From<Joint> for RecordedBone {
    fn from(joint: Joint) -> Self {
        Self { name: joint.name, parent: joint.parent, offset: joint.offset, end: joint.end }
    }
}

/// If the root's only child has position channels, makes that child the root. Returns a note about it.
fn merge_carrier(joints: &mut Vec<Joint>, motion: &mut Motion) -> Option<String> {
    let [root, child, others @ ..] = joints.as_slice() else { return None };
    let places = motion.places.get(1).filter(|places| !places.is_empty())?;
    if others.iter().any(|other| other.parent == Some(0)) {
        return None;
    }
    let note = format!("`{}` carries `{}`, which is the root of the clip", root.name, child.name);
    let carrier = motion.places.first().filter(|places| !places.is_empty());
    let merged = motion.rotations.iter_mut().zip(places).enumerate().map(|(frame, (rotations, place))| {
        let outer = rotations.remove(0);
        if let Some(inner) = rotations.first_mut() {
            *inner = multiply(outer, *inner);
        }
        let origin = carrier.and_then(|places| places.get(frame)).copied().unwrap_or(root.offset);
        add(origin, rotated(outer, *place))
    });
    let merged: Vec<Vector> = merged.collect();
    motion.places.remove(0);
    if let Some(places) = motion.places.first_mut() {
        *places = merged;
    }
    joints.remove(0);
    for joint in joints {
        joint.parent = joint.parent.and_then(|parent| parent.checked_sub(1));
    }
    Some(note)
}

/// Replaces the offsets of joints with position channels by the medians. Returns a note if that loses motion.
fn settle(joints: &mut [Joint], places: &[Vec<Vector>]) -> Option<String> {
    let mut moving = Vec::new();
    for (joint, places) in joints.iter_mut().zip(places).skip(1).filter(|(_, places)| !places.is_empty()) {
        if moves(joint, places) {
            moving.push(format!("`{}`", joint.name));
        }
        joint.offset = median(places);
    }
    let first = moving.first()?;
    let others =
        if moving.len() > 1 { format!(" and {} other joints move", moving.len() - 1) } else { " moves".into() };
    Some(format!("{first}{others} relative to the parent; bones are rigid, so the median place is used"))
}

/// Whether the joint's distance to its parent's frame changes by more than rounding explains.
fn moves(joint: &Joint, places: &[Vector]) -> bool {
    let middle = median(places);
    let slack = MOVES * norm(&middle).max(norm(&joint.offset)) + ROUNDING;
    places.iter().any(|place| norm(&subtract(*place, middle)) > slack)
}

/// The median of each coordinate.
fn median(places: &[Vector]) -> Vector {
    std::array::from_fn(|axis| {
        let mut values: Vec<f64> = places.iter().map(|place| place[axis]).collect();
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or_default()
    })
}
