//! A recorded motion on a skeleton of its own, as the readers of BVH and SMPL files give it.

use std::path::PathBuf;

use crate::spatial::{Quaternion, Vector};

/// A motion on the skeleton of its file. Lengths are in the file's unit; axes are the file's, right-handed.
#[derive(Clone, Debug)]
pub struct Recorded {
    /// The file, for messages.
    pub path: PathBuf,
    /// Parents come before their children; the first is the root.
    pub bones: Vec<RecordedBone>,
    /// Whether the rest pose, in which no bone is turned, is in the axes of the world, as in most BVH files. Else it does
    /// not show which axis is up: in SMPL the root's rotation turns it into the world.
    pub rest_in_world: bool,
    /// Seconds between frames.
    pub frame_seconds: f64,
    /// At least one.
    pub frames: Vec<RecordedPose>,
}

/// A joint of the skeleton. Its frame turns with its own rotation.
#[derive(Clone, Debug)]
pub struct RecordedBone {
    /// The name in the file, without a namespace ("mixamorig:Hips" is "Hips").
    pub name: String,
    /// `None` for the root.
    pub parent: Option<usize>,
    /// Its origin in the frame of its parent. The root's is not used: a pose has its position.
    pub offset: Vector,
    /// Where the bone ends, in its own frame, if it has no children and the file says it.
    pub end: Option<Vector>,
}

/// One frame.
#[derive(Clone, Debug)]
pub struct RecordedPose {
    /// Origin of the root in the world.
    pub position: Vector,
    /// Rotation of each bone in the frame of its parent; the root's in the world.
    pub rotations: Vec<Quaternion>,
}
