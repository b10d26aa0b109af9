//! The recorded motion as places and orientations of a person's parts: world frame, z up, one pose per step.

use std::ops::Range;

use super::axes::Axis;
use super::geometry::{across, unit};
use super::recorded::{Recorded, RecordedPose};
use super::resample::{count, resample};
use super::roles::{Role, Roles};
use crate::error::Error;
use crate::import::DT;
use crate::spatial::{IDENTITY, Quaternion, Vector, add, dot, multiply, norm, rotated, scale, subtract};

/// Slowest recording that is accepted, Hz. A step of a run lasts about 0.3 s.
const SLOWEST: f64 = 20.0;
/// Fastest recording that is accepted, Hz.
const FASTEST: f64 = 10_000.0;
/// Most steps of a clip, as for a clip that is read.
const MOST_STEPS: usize = 100_000;
/// Largest number in a recording that is accepted: 10 km in mm.
const LARGEST: f64 = 1e7;
/// Frames that are looked at to find the direction up and the lengths. More do not change a mean.
const SAMPLES: usize = 500;
/// In a pose that stands, the cosines between limbs and trunk are larger than this: 45 degrees.
const UPRIGHT: f64 = 0.7;
/// A foot that points less than this away from the shin has no direction along the floor: the sine of 17 degrees. The line
/// from ankle to ball has about 70 degrees.
pub(super) const POINTS: f64 = 0.3;

/// The parts of a person in one pose.
#[derive(Clone, Debug)]
pub(super) struct Person {
    /// Where the parts begin, m; also the wrists and the balls of the feet of a skeleton without those bones.
    position: [Vector; Role::COUNT],
    /// Orientation of the bones that have a role.
    quaternion: [Quaternion; Role::COUNT],
}

impl Person {
    pub(super) fn place(&self, role: Role) -> Vector {
        self.position[role as usize]
    }

    pub(super) fn turn(&self, role: Role) -> Quaternion {
        self.quaternion[role as usize]
    }

    /// From one part to another, m.
    pub(super) fn between(&self, from: Role, to: Role) -> Vector {
        subtract(self.place(to), self.place(from))
    }

    /// The point between two parts, m.
    pub(super) fn middle(&self, a: Role, b: Role) -> Vector {
        scale(0.5, add(self.place(a), self.place(b)))
    }

    /// From the middle of the hip joints to the middle of the shoulders, m.
    pub(super) fn trunk(&self) -> Vector {
        subtract(self.middle(Role::LeftUpperArm, Role::RightUpperArm), self.middle(Role::LeftThigh, Role::RightThigh))
    }

    /// From the right hip joint to the left one, m.
    pub(super) fn lateral(&self) -> Vector {
        self.between(Role::RightThigh, Role::LeftThigh)
    }

    /// Length of the leg, mean of both sides.
    fn leg(&self) -> f64 {
        let length = |from, to| norm(&self.between(from, to));
        0.5 * (length(Role::LeftThigh, Role::LeftShin)
            + length(Role::LeftShin, Role::LeftFoot)
            + length(Role::RightThigh, Role::RightShin)
            + length(Role::RightShin, Role::RightFoot))
    }
}

/// A checked recording with its roles.
pub(super) struct Source<'a> {
    recorded: &'a Recorded,
    roles: &'a Roles,
    /// The frames in use. What is before and after them counts for nothing.
    frames: &'a [RecordedPose],
    /// Their indices in the recording.
    pub(super) window: Range<usize>,
    /// Whether the ball of the left and of the right foot is known.
    pub(super) balls: [bool; 2],
}

impl<'a> Source<'a> {
    /// `frames` are the recorded frames to use; all of them if it is `None`.
    ///
    /// # Errors
    /// [`Error::Recording`] if numbers, lengths or roles are not those of a person, or if the frames give no clip.
    pub(super) fn new(recorded: &'a Recorded, roles: &'a Roles, frames: Option<Range<usize>>) -> Result<Self, Error> {
        check(recorded)?;
        roles.check(recorded)?;
        let window = window(recorded, frames)?;
        let frames = recorded.frames.get(window.clone()).unwrap_or_default();
        let mut source = Self { recorded, roles, frames, window, balls: [false; 2] };
        source.check_lengths()?;
        source.balls = source.find_balls();
        Ok(source)
    }

    /// Whether the ball of each foot is known. The end of some skeletons' feet is straight below the ankle. It does not
    /// say where the foot points, so it is no ball.
    fn find_balls(&self) -> [bool; 2] {
        let rest = self.rest(Axis::Z);
        let sides =
            [[Role::LeftShin, Role::LeftFoot, Role::LeftToes], [Role::RightShin, Role::RightFoot, Role::RightToes]];
        sides.map(|[shin, foot, toes]| {
            if !self.has(toes) && self.roles.get(foot).and_then(|foot| self.tip(foot)).is_none() {
                return false;
            }
            let sine =
                |person: &Person| norm(&across(unit(person.between(foot, toes)), unit(person.between(shin, foot))));
            if rest.stands() {
                return sine(&rest) > POINTS;
            }
            let (mut points, mut all) = (0, 0);
            for person in self.samples() {
                points += usize::from(sine(&person) > POINTS);
                all += 1;
            }
            2 * points > all
        })
    }

    pub(super) fn has(&self, role: Role) -> bool {
        self.roles.get(role).is_some()
    }

    /// The name of the bone with a role.
    pub(super) fn name(&self, role: Role) -> &str {
        self.roles.get(role).and_then(|bone| self.recorded.bones.get(bone)).map_or("", |bone| bone.name.as_str())
    }

    /// Where a bone ends, in its own frame: its end, or its first child's origin.
    fn tip(&self, bone: usize) -> Option<Vector> {
        let child = || self.recorded.bones.iter().find(|other| other.parent == Some(bone)).map(|child| child.offset);
        self.recorded.bones.get(bone)?.end.or_else(child)
    }

    /// The person, if each bone has this place relative to its parent's origin, and each rotation is the given one.
    fn person(&self, pose: &RecordedPose) -> Person {
        let mut bones: Vec<(Vector, Quaternion)> = Vec::with_capacity(self.recorded.bones.len());
        for (bone, rotation) in self.recorded.bones.iter().zip(&pose.rotations) {
            let placed = match bone.parent.and_then(|parent| bones.get(parent)) {
                Some((place, outer)) => (add(*place, rotated(*outer, bone.offset)), multiply(*outer, *rotation)),
                None => (pose.position, *rotation),
            };
            bones.push(placed);
        }
        let mut person = Person { position: [[0.0; 3]; Role::COUNT], quaternion: [IDENTITY; Role::COUNT] };
        for role in Role::all() {
            if let Some((place, turn)) = self.roles.get(role).and_then(|bone| bones.get(bone)) {
                person.position[role as usize] = *place;
                person.quaternion[role as usize] = *turn;
            }
        }
        for (carrier, role) in [
            (Role::LeftFoot, Role::LeftToes),
            (Role::RightFoot, Role::RightToes),
            (Role::LeftForearm, Role::LeftHand),
            (Role::RightForearm, Role::RightHand),
        ] {
            let carrier = self.roles.get(carrier);
            if !self.has(role)
                && let Some(tip) = carrier.and_then(|bone| self.tip(bone))
                && let Some((place, turn)) = carrier.and_then(|bone| bones.get(bone))
            {
                person.position[role as usize] = add(*place, rotated(*turn, tip));
            }
        }
        person
    }

    /// Some of the recorded persons, in the file's axes and unit.
    pub(super) fn samples(&self) -> impl Iterator<Item = Person> {
        self.frames.iter().step_by(self.frames.len().div_ceil(SAMPLES).max(1)).map(|pose| self.person(pose))
    }

    /// The persons of the first frames in use, in the file's axes and unit.
    pub(super) fn first(&self, count: usize) -> Vec<Person> {
        self.frames.iter().take(count).map(|pose| self.person(pose)).collect()
    }

    /// Mean length of the legs, in the file's unit.
    pub(super) fn leg(&self) -> f64 {
        let (mut sum, mut count) = (0.0, 0.0);
        for person in self.samples() {
            sum += person.leg();
            count += 1.0;
        }
        sum / count
    }

    /// Whether the rest pose shows which axis of the file's world is up.
    pub(super) fn rest_in_world(&self) -> bool {
        self.recorded.rest_in_world
    }

    /// The optional roles without a bone that matter.
    pub(super) fn missing(&self) -> Vec<&'static str> {
        self.roles.missing()
    }

    /// The person in the skeleton's rest pose, in which no bone is turned. Lengths are in the file's unit.
    pub(super) fn rest(&self, up: Axis) -> Person {
        let rotations = vec![IDENTITY; self.recorded.bones.len()];
        self.person(&RecordedPose { position: [0.0; 3], rotations }).converted(up, 1.0)
    }

    /// Smooths the frames in use, and gives one person per [`DT`]. One unit of the file becomes `meters` m.
    pub(super) fn persons(&self, up: Axis, meters: f64) -> Vec<Person> {
        let poses = resample(self.frames, self.recorded.frame_seconds, DT);
        poses.iter().map(|pose| self.person(pose).converted(up, meters)).collect()
    }

    /// Checks that the bones which give directions have lengths.
    fn check_lengths(&self) -> Result<(), Error> {
        let refuse = |reason: String| Err(Error::Recording { path: self.recorded.path.clone(), reason });
        let Some(person) = self.samples().next() else { return refuse("no frames".into()) };
        let leg = self.leg();
        for (from, to) in [
            (Role::LeftThigh, Role::LeftShin),
            (Role::LeftShin, Role::LeftFoot),
            (Role::RightThigh, Role::RightShin),
            (Role::RightShin, Role::RightFoot),
            (Role::LeftUpperArm, Role::LeftForearm),
            (Role::LeftForearm, Role::LeftHand),
            (Role::RightUpperArm, Role::RightForearm),
            (Role::RightForearm, Role::RightHand),
            (Role::RightThigh, Role::LeftThigh),
        ] {
            let length = norm(&person.between(from, to));
            if length.is_nan() || length < 0.01 * leg || length == 0.0 {
                return refuse(format!(
                    "the distance from bone `{}` to {} is {length}, too short beside a leg of {leg}; \
                     say which bone has which role with --bones FILE",
                    self.name(from),
                    to.name()
                ));
            }
        }
        Ok(())
    }
}

impl Person {
    /// Whether this is a pose of a person who stands: the legs go down from the trunk, and are straight.
    pub(super) fn stands(&self) -> bool {
        let trunk = unit(self.trunk());
        let lateral = unit(self.lateral());
        let shoulders = self.between(Role::RightUpperArm, Role::LeftUpperArm);
        let sides =
            [[Role::LeftThigh, Role::LeftShin, Role::LeftFoot], [Role::RightThigh, Role::RightShin, Role::RightFoot]];
        let legs = sides.iter().all(|[thigh, shin, foot]| {
            let upper = unit(self.between(*thigh, *shin));
            let lower = unit(self.between(*shin, *foot));
            -dot(&upper, &trunk) > UPRIGHT && dot(&upper, &lower) > UPRIGHT
        });
        // The line between the hip joints is across the trunk, as that between the shoulders.
        legs && norm(&self.trunk()) > 0.0
            && dot(&lateral, &trunk).abs() < 0.3
            && dot(&lateral, &unit(shoulders)) > UPRIGHT
    }

    /// Turns `up` to z and changes the unit.
    fn converted(mut self, up: Axis, meters: f64) -> Self {
        let turn = up.to_z();
        for (position, quaternion) in self.position.iter_mut().zip(&mut self.quaternion) {
            *position = scale(meters, rotated(turn, *position));
            *quaternion = multiply(turn, *quaternion);
        }
        self
    }
}

/// Checks that a recording is a tree with frames of finite numbers, not too large, at a known rate.
fn check(recorded: &Recorded) -> Result<(), Error> {
    let refuse = |reason: String| Err(Error::Recording { path: recorded.path.clone(), reason });
    let rate = 1.0 / recorded.frame_seconds;
    if !(SLOWEST..=FASTEST).contains(&rate) {
        return refuse(format!(
            "{rate:.3} frames per second, expected {SLOWEST} to {FASTEST}: give a recording with more frames"
        ));
    }
    let fits = |vector: &Vector| vector.iter().all(|part| part.abs() <= LARGEST);
    for (index, bone) in recorded.bones.iter().enumerate() {
        if bone.parent.is_some_and(|parent| parent >= index) || (bone.parent.is_none() != (index == 0)) {
            return refuse(format!("bone `{}` does not come after its parent", bone.name));
        }
        if !fits(&bone.offset) || !bone.end.as_ref().is_none_or(fits) {
            return refuse(format!("bone `{}` has a length that is no number up to {LARGEST}", bone.name));
        }
    }
    for (frame, pose) in recorded.frames.iter().enumerate() {
        if pose.rotations.len() != recorded.bones.len() {
            let (has, bones) = (pose.rotations.len(), recorded.bones.len());
            return refuse(format!("frame {frame} has {has} rotations for {bones} bones"));
        }
        let unit = |rotation: &Quaternion| (0.9..1.1).contains(&norm(rotation));
        if !fits(&pose.position) || !pose.rotations.iter().all(unit) {
            return refuse(format!("frame {frame} has a position beyond {LARGEST}, or a rotation that is none"));
        }
    }
    Ok(())
}

/// The indices of the frames in use. They must give two poses, because a velocity needs two.
fn window(recorded: &Recorded, frames: Option<Range<usize>>) -> Result<Range<usize>, Error> {
    let total = recorded.frames.len();
    let Range { start, end } = frames.unwrap_or(0..total);
    let window = start..end.min(total);
    let reason = match count(window.len(), recorded.frame_seconds, DT) {
        0..2 => format!("frames {start}..{end} of {total} are too few: a clip needs 0.03 s; frames are counted from 0"),
        poses if poses > MOST_STEPS => {
            format!("{poses} steps, more than {MOST_STEPS}: use a part of the frames with --frames")
        }
        _ => return Ok(window),
    };
    Err(Error::Recording { path: recorded.path.clone(), reason })
}
