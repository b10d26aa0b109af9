//! The features of a motion, by forward kinematics.

use crate::body::{BODIES, Frames, ROOT, body};
use crate::clip::{Features, Motion};
use crate::spatial::{subtract, unrotate};

/// The bodies of `appendages` in dm_control's order: the four end effectors, then the head.
const APPENDAGES: [usize; 5] = [body("rradius"), body("lradius"), body("rfoot"), body("lfoot"), body("head")];

impl Features {
    /// Computes the features of every frame of a motion for the CMU humanoid V2020, in the layout of dm_control's
    /// converters.
    pub fn of(motion: &Motion) -> Self {
        let mut features = Self::default();
        for ((position, quaternion), joints) in motion.position.iter().zip(&motion.quaternion).zip(&motion.joints) {
            features.push(&Frames::of(position, quaternion, joints));
        }
        features
    }

    fn push(&mut self, frames: &Frames) {
        let mut appendages = [0.0; 15];
        for (place, appendage) in appendages.chunks_exact_mut(3).zip(APPENDAGES) {
            let offset = subtract(frames.position[appendage], frames.position[ROOT]);
            place.copy_from_slice(&unrotate(&frames.rotation[ROOT], offset));
        }
        self.center_of_mass.push(frames.center_of_mass());
        self.end_effectors.push(std::array::from_fn(|part| appendages[part]));
        self.appendages.push(appendages);
        for tracked in ROOT + 1..BODIES {
            self.body_positions.extend(frames.position[tracked]);
            self.body_quaternions.extend(frames.quaternion[tracked]);
        }
    }
}
