//! Follows environments and keeps what a page shows of their episodes.

use std::collections::BTreeMap;

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use comic_experiment::TaskSpec;
use comic_tasks::geometry::{Form, Geometry, Pose, ReferencePoses};
use comic_tasks::{Ghost, Outcome, Simulated, Step};

use super::document::{Document, Episode, Poses, Scene, Shape};
use crate::Error;

/// Records episodes.
pub struct PageRecorder<'a> {
    spec: &'a TaskSpec,
    /// Control steps from one pose to the next.
    every: usize,
    /// The shapes of each model, and where the reference is in it.
    geometries: Vec<(Geometry, Option<ReferencePoses>)>,
    /// By the number of the episode's start.
    recordings: BTreeMap<usize, Recording>,
}

/// An episode so far.
struct Recording {
    clip: usize,
    start: usize,
    steps_left: usize,
    scene: usize,
    poses: Vec<Vec<Pose>>,
    reference: Vec<Vec<Pose>>,
    targets: Vec<[f32; 2]>,
    /// The terms of each step.
    rewards: Vec<Vec<f64>>,
}

/// How an episode ended.
pub struct Ending {
    /// The number of its start.
    pub number: usize,
    /// What the list says of it before its clip and its start; empty for nothing.
    pub remark: String,
    /// Why it ended.
    pub outcome: Outcome,
    /// Its normalised reward.
    pub normalised_reward: f64,
}

impl<'a> PageRecorder<'a> {
    /// Records a pose every `every` control steps and at an episode's end, and the rewards of all steps.
    pub fn new(spec: &'a TaskSpec, every: usize) -> Self {
        Self { spec, every: every.max(1), geometries: Vec::new(), recordings: BTreeMap::new() }
    }

    /// Records the present state of an environment: an episode's begin, without a step, or what is after a step. `number` is
    /// that of the episode's start.
    ///
    /// # Errors
    /// A model without the humanoid.
    pub fn record(&mut self, number: usize, environment: &dyn Simulated, step: Option<&Step>) -> Result<(), Error> {
        let mut recording = match self.recordings.remove(&number) {
            Some(recording) => recording,
            None => self.begin(environment)?,
        };
        if let Some(step) = step {
            recording.rewards.push(step.reward_terms.iter().take(self.spec.reward_terms.len()).copied().collect());
        }
        let last = step.is_some_and(|step| step.outcome != Outcome::Running);
        if let Some((geometry, reference)) = self.geometries.get_mut(recording.scene)
            && (last || recording.rewards.len().is_multiple_of(self.every))
        {
            recording.poses.push(geometry.poses(environment));
            recording.reference.extend(reference.as_mut().map(|reference| reference.poses(geometry, environment)));
            recording.targets.extend(environment.scenery().target.map(|target| target.map(|place| place as f32)));
        }
        self.recordings.insert(number, recording);
        Ok(())
    }

    fn begin(&mut self, environment: &dyn Simulated) -> Result<Recording, Error> {
        let known = self.geometries.iter().position(|(geometry, _)| geometry.is_of(environment));
        let scene = match known {
            Some(scene) => scene,
            None => {
                let has_reference = environment.scenery().reference.is_some();
                let reference = has_reference.then(|| ReferencePoses::new(environment));
                self.geometries.push((Geometry::new(environment)?, reference));
                self.geometries.len() - 1
            }
        };
        let episode = environment.episode();
        Ok(Recording {
            clip: episode.clip,
            start: episode.start,
            steps_left: episode.steps_left,
            scene,
            poses: Vec::new(),
            reference: Vec::new(),
            targets: Vec::new(),
            rewards: Vec::new(),
        })
    }

    /// The page, with control steps of `step` seconds. It has the episodes that have ended, in the order of `endings`, and then
    /// those that have not.
    pub fn document(mut self, title: String, step: f64, ghost: Option<Ghost>, endings: &[Ending]) -> Document {
        let mut episodes = Vec::new();
        for ending in endings {
            let recording = self.recordings.remove(&ending.number);
            episodes.extend(recording.map(|recording| recording.episode(self.spec, self.every, Some(ending))));
        }
        episodes.extend(self.recordings.into_values().map(|recording| recording.episode(self.spec, self.every, None)));
        let scenes = self.geometries.iter().map(|(geometry, _)| scene(geometry)).collect();
        let ghost = match ghost {
            None => "off",
            Some(Ghost::On) => "on",
            Some(Ghost::Beside) => "beside",
        };
        Document { title, step, terms: self.spec.reward_terms.clone(), ghost, scenes, episodes }
    }
}

impl Recording {
    fn episode(mut self, spec: &TaskSpec, every: usize, ending: Option<&Ending>) -> Episode {
        // The last steps have no pose if the film ended there.
        self.rewards.truncate(self.poses.len().saturating_sub(1) * every);
        let steps = self.rewards.len();
        let clip = spec.clips.get(self.clip).map_or("", String::as_str);
        let place = format!("{clip} from {}", self.start);
        let name = match ending {
            Some(ending) if !ending.remark.is_empty() => format!("{}: {place}", ending.remark),
            _ => place,
        };
        let length = format!("{steps} of {} steps", self.steps_left);
        let note = match ending {
            None => format!("{length}, the film ends"),
            Some(Ending { outcome, normalised_reward, .. }) => {
                let end = match outcome {
                    Outcome::Terminated => "failed",
                    Outcome::Diverged => "the simulation diverged",
                    Outcome::Running | Outcome::Truncated => "to the end",
                };
                format!("{length}, {end}, normalised reward {normalised_reward:.3}")
            }
        };
        let term = |term: usize| self.rewards.iter().map(|terms| terms[term] as f32).collect();
        Episode {
            name,
            note,
            scene: self.scene,
            steps,
            every,
            poses: packed(&self.poses),
            reference: (!self.reference.is_empty()).then(|| packed(&self.reference)),
            targets: self.targets,
            rewards: (0..spec.reward_terms.len()).map(term).collect(),
        }
    }
}

fn scene(geometry: &Geometry) -> Scene {
    let shape = |shape: &comic_tasks::geometry::Shape| Shape {
        form: match shape.form {
            Form::Plane => "plane",
            Form::Sphere => "sphere",
            Form::Capsule => "capsule",
            Form::Ellipsoid => "ellipsoid",
            Form::Cylinder => "cylinder",
            Form::Box => "box",
        },
        size: shape.size.map(|size| size as f32),
        colour: shape.colour,
        body: shape.body,
        position: shape.pose.position.map(|place| place as f32),
        rotation: shape.pose.rotation.map(|part| part as f32),
    };
    Scene { shapes: geometry.shapes().iter().map(shape).collect() }
}

/// Packs the poses of each frame.
fn packed(frames: &[Vec<Pose>]) -> Poses {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for pose in frames.iter().flatten() {
        for (axis, place) in pose.position.into_iter().enumerate() {
            (low[axis], high[axis]) = (low[axis].min(place), high[axis].max(place));
        }
    }
    if frames.iter().all(Vec::is_empty) {
        (low, high) = ([0.0; 3], [0.0; 3]);
    }
    let mut bytes = Vec::new();
    for pose in frames.iter().flatten() {
        for (axis, place) in pose.position.into_iter().enumerate() {
            let range = (high[axis] - low[axis]).max(f64::MIN_POSITIVE);
            let level = ((place - low[axis]) / range * f64::from(u16::MAX)).round();
            bytes.extend((level as u16).to_le_bytes());
        }
        for part in pose.rotation {
            bytes.extend(((part * f64::from(i16::MAX)).round() as i16).to_le_bytes());
        }
    }
    Poses { bodies: frames.first().map_or(0, Vec::len), low, high, data: BASE64_STANDARD.encode(bytes) }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The poses of a frame, as the page reads them.
    fn unpacked(poses: &Poses) -> Vec<Pose> {
        let bytes = BASE64_STANDARD.decode(&poses.data).unwrap();
        let read = |pose: &[u8]| {
            let number = |place: usize| [pose[2 * place], pose[2 * place + 1]];
            let position = std::array::from_fn(|axis| {
                let level = f64::from(u16::from_le_bytes(number(axis))) / f64::from(u16::MAX);
                poses.low[axis] + level * (poses.high[axis] - poses.low[axis])
            });
            let rotation =
                std::array::from_fn(|part| f64::from(i16::from_le_bytes(number(3 + part))) / f64::from(i16::MAX));
            Pose { position, rotation }
        };
        bytes.chunks_exact(14).map(read).collect()
    }

    proptest! {
        /// 60 m, the longest corridor, in 65,535 levels: an error of half a millimetre at most.
        #[test]
        fn packed_poses_are_right_to_half_a_millimetre(
            places in prop::collection::vec([-30.0..30.0, -30.0..30.0, 0.0..3.0], 1..20),
            rotation in [-1.0..=1.0, -1.0..=1.0, -1.0..=1.0, -1.0..=1.0],
        ) {
            let frames: Vec<Vec<Pose>> = places.into_iter().map(|position| vec![Pose { position, rotation }; 2]).collect();
            let packed = packed(&frames);
            prop_assert_eq!(packed.bodies, 2);
            let read = unpacked(&packed);
            prop_assert_eq!(read.len(), 2 * frames.len());
            for (read, written) in read.iter().zip(frames.iter().flatten()) {
                for axis in 0..3 {
                    prop_assert!((read.position[axis] - written.position[axis]).abs() < 5e-4);
                }
                for part in 0..4 {
                    prop_assert!((read.rotation[part] - written.rotation[part]).abs() < 2e-5);
                }
            }
        }
    }

    #[test]
    fn a_body_that_never_moves_and_an_episode_without_poses_are_packed() {
        let still = Pose { position: [1.0, -2.0, 0.5], rotation: [1.0, 0.0, 0.0, 0.0] };
        assert_eq!(unpacked(&packed(&[vec![still], vec![still]])), [still, still]);
        let none = packed(&[]);
        assert_eq!((none.bodies, none.low, none.data.as_str()), (0, [0.0; 3], ""));
    }
}
