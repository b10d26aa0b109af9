//! A reference clip in the form that the task reads.

use comic_clips::{Clip, Entry, Features, Motion};

use crate::error::Error;
use crate::humanoid::features;
use crate::humanoid::walker::Walker;
use crate::physics::Data;

/// Largest allowed difference between a clip's first frame and the body in the same pose (`tracking.py`,
/// `initialize_episode`).
const MISMATCH: f64 = 1e-2;

/// The frames of a clip that the task uses, counted from the sub-range's first frame. Reading after the last frame gives
/// the last frame. No episode reads there; the rule only prevents a panic.
#[derive(Debug)]
pub(crate) struct Reference {
    /// Seconds between frames.
    pub(crate) dt: f64,
    /// First frame in the clip, and number of frames.
    pub(crate) first: usize,
    pub(crate) frames: usize,
    motion: Motion,
    features: Features,
    bodies: usize,
}

impl Reference {
    /// Takes the sub-range of `entry`. The body's kinematics give the features when the clip has none.
    pub(crate) fn new(clip: Clip, entry: &Entry, walker: &Walker, data: &mut Data) -> Result<Self, Error> {
        let range = entry.frames();
        if range.is_empty() || range.end > clip.steps() {
            let reason =
                format!("it has {} frames, and frames {range:?} are needed; has its file been replaced?", clip.steps());
            return Err(Error::Clip { clip: clip.name, reason });
        }
        let features = match clip.features {
            Some(features) => features,
            None => features::features(walker, data, &clip.motion),
        };
        let reference = Self {
            dt: clip.dt,
            first: range.start,
            frames: range.len(),
            motion: clip.motion,
            features,
            bodies: walker.model.bodies(),
        };
        reference.check(&clip.name, walker, data)?;
        Ok(reference)
    }

    /// Refuses a clip that was made for another body: the positions of its bodies differ from this body's.
    fn check(&self, name: &str, walker: &Walker, data: &mut Data) -> Result<(), Error> {
        features::pose(data, &self.motion, self.first);
        let bodies = data.xpos()[walker.tracked.clone()].as_flattened();
        let deviation = bodies.iter().zip(self.body_positions(0)).map(|(a, b)| (a - b).abs()).sum::<f64>();
        let error = 0.5 * deviation / bodies.len() as f64;
        if error.is_nan() || error > MISMATCH {
            return Err(Error::Clip {
                clip: name.into(),
                reason: format!(
                    "its first frame is {error:.3} away from this body in the same pose, the limit is {MISMATCH}; \
                     it was made for another body, convert it or leave it out"
                ),
            });
        }
        Ok(())
    }

    /// The last frame of an episode whose references reach `look_ahead` frames ahead.
    pub(crate) fn last_step(&self, look_ahead: usize) -> usize {
        self.frames.saturating_sub(look_ahead + 1)
    }

    /// Time from the first to the last frame, s.
    pub(crate) fn duration(&self) -> f64 {
        self.frames.saturating_sub(1) as f64 * self.dt
    }

    fn at(&self, frame: usize) -> usize {
        self.first + frame.min(self.frames.saturating_sub(1))
    }

    pub(crate) fn position(&self, frame: usize) -> &[f64; 3] {
        &self.motion.position[self.at(frame)]
    }

    pub(crate) fn quaternion(&self, frame: usize) -> &[f64; 4] {
        &self.motion.quaternion[self.at(frame)]
    }

    pub(crate) fn joints(&self, frame: usize) -> &[f64; 56] {
        &self.motion.joints[self.at(frame)]
    }

    pub(crate) fn joints_velocity(&self, frame: usize) -> &[f64; 56] {
        &self.motion.joints_velocity[self.at(frame)]
    }

    pub(crate) fn center_of_mass(&self, frame: usize) -> &[f64; 3] {
        &self.features.center_of_mass[self.at(frame)]
    }

    pub(crate) fn appendages(&self, frame: usize) -> &[f64; 15] {
        &self.features.appendages[self.at(frame)]
    }

    /// `[B × 3]`.
    pub(crate) fn body_positions(&self, frame: usize) -> &[f64] {
        let width = 3 * self.bodies;
        &self.features.body_positions[self.at(frame) * width..][..width]
    }

    /// `[B][4]`.
    pub(crate) fn body_quaternions(&self, frame: usize) -> &[[f64; 4]] {
        let width = 4 * self.bodies;
        self.features.body_quaternions[self.at(frame) * width..][..width].as_chunks().0
    }

    /// Generalised coordinates: root position and quaternion, joints.
    pub(crate) fn qpos(&self, frame: usize) -> [f64; 63] {
        let mut qpos = [0.0; 63];
        qpos[..3].copy_from_slice(self.position(frame));
        qpos[3..7].copy_from_slice(self.quaternion(frame));
        qpos[7..].copy_from_slice(self.joints(frame));
        qpos
    }

    /// Generalised velocities: root linear (world) and angular (root frame), joints.
    pub(crate) fn qvel(&self, frame: usize) -> [f64; 62] {
        let index = self.at(frame);
        let mut qvel = [0.0; 62];
        qvel[..3].copy_from_slice(&self.motion.velocity[index]);
        qvel[3..6].copy_from_slice(&self.motion.angular_velocity[index]);
        qvel[6..].copy_from_slice(self.joints_velocity(frame));
        qvel
    }
}

#[cfg(test)]
mod tests {
    use comic_clips::{Catalogue, WalkerModel};
    use comic_experiment::ClipSource;

    use super::*;
    use crate::humanoid;
    use crate::physics::Models;

    #[test]
    fn a_clip_of_another_body_is_refused_by_name() {
        let model = humanoid::build(WalkerModel::Cmu2020).unwrap();
        let walker = Walker::new(WalkerModel::Cmu2020, &model).unwrap();
        let mut data = Models::new(model, 6).data();
        let catalogue = Catalogue::open(&[ClipSource::whole("builtin:stand")]).unwrap();
        let entry = &catalogue.entries()[0];
        for (scale, accepted) in [(1.0, true), (0.83, false), (f64::NAN, false)] {
            let mut clip = catalogue.load(0).unwrap();
            let mut features = features::features(&walker, &mut data, &clip.motion);
            for position in &mut features.body_positions {
                *position *= scale;
            }
            clip.features = Some(features);
            match Reference::new(clip, entry, &walker, &mut data) {
                Ok(_) => assert!(accepted),
                Err(error) => assert!(!accepted && error.to_string().starts_with("clip stand: its first frame")),
            }
        }
    }
}
