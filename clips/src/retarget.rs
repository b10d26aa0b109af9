//! Motion of other skeletons on the CMU humanoid V2020.
//!
//! # Layout
//! - [`read_bvh`] and [`read_smpl`] read files into a [`Recorded`]; [`find_roles`] finds which bone is which part of a
//!   person;
//! - [`retarget`] makes the clip and a [`Report`] about it. Its modules in the order of their work: `person` checks
//!   the recording, `up` finds the direction up, `axes` the unit, `resample` the poses, `align` how the bodies lie in the
//!   bones, `target` says which body follows which bone, `ik` finds the body's poses, `feet` lets standing feet stand,
//!   `bridge` removes jumps of a limb.

mod align;
mod axes;
mod bridge;
mod bvh;
mod feet;
mod geometry;
mod ik;
mod linear;
mod names;
mod npz;
mod person;
mod recorded;
mod report;
mod resample;
mod roles;
mod smpl;
mod target;
mod up;

use std::f64::consts::FRAC_PI_2;
use std::ops::Range;

pub use axes::{Axis, parse_unit};
pub use bvh::read_bvh;
pub use names::{find_roles, read_roles};
pub use recorded::{Recorded, RecordedBone, RecordedPose};
pub use report::{AtLimit, BoneError, PlaceError, Report};
pub use roles::{Role, Roles};
pub use smpl::read_smpl;

use crate::body::{ROOT, joint};
use crate::clip::{Clip, Features};
use crate::error::Error;
use crate::humanoid::WalkerModel;
use crate::import::{DT, Floor, Poses, THUMBS, motion};
use crate::spatial::{IDENTITY, Quaternion, Vector, about, add, aligned, multiply, norm, rotate, scale, subtract};
use geometry::angle;
use ik::{Goal, Pose, Reach, Solver};
use person::{Person, Source};
use target::{Link, SIDES};

/// Length of V2020's leg from hip joint to ankle, m.
const LEG: f64 = 0.485934 + 0.4988316;
/// A greater correction of a sole is mentioned, degrees. It is more than shoes and markers explain.
const TILTED: f64 = 25.0;

// The weights are relative to 1 for the direction of a limb. They are chosen so that recordings of the humanoid itself come
// back within 1 degree (`tests/retarget.rs`), and CMU's within a few degrees of the import (`tests/retarget_asf.rs`).

/// Weight of the distance of a joint to its neutral angle, rad⁻². It spreads a bend over joints that no bone shows.
const STIFFNESS: f64 = 1e-3;
/// Weight of the distance of a joint to its angle one step before, rad⁻².
const INERTIA: f64 = 1e-3;
/// Weight of the root's place, 1/m², beside the feet's.
const ROOT_PLACE: f64 = 20.0;
/// Weight of the wrist's place seen from the shoulder, 1/m². It counts if an arm cannot have its directions.
const WRIST: f64 = 12.0;
// A search that begins at the pose of the step before can stay in a worse posture. The next four numbers say when another
// posture is tried. They save time, because two searches for each step take twice as long.

/// A pose that is worse than this is tried again from the neutral pose, if it is new that it is so bad.
const BAD: f64 = 0.05;
/// A value that grows by this factor from one step to the next is new.
const NEW: f64 = 1.5;
/// Poses that stay bad are tried again after this many steps.
const RETRY: usize = 10;
/// A pose from the neutral pose replaces one from the step before if it is better by this factor.
const BETTER: f64 = 0.5;

/// Choices of a retargeting. What is `None` is found from the recording.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Options {
    /// The clip's name.
    pub name: String,
    /// The axis of the file's world that points up. Default: the axis along which the body is upright in most frames, or
    /// else that of the rest pose.
    pub up: Option<Axis>,
    /// The file's unit of length, m. Default: that of m, cm, mm, inch and CMU's unit in which the legs are most like a
    /// human's.
    pub unit_meters: Option<f64>,
    /// Factor for all lengths, after the unit. Default: V2020's leg divided by the subject's leg.
    pub scale: Option<f64>,
    /// The recorded frames to use, counted from 0, without the end. The others change nothing. Default: all.
    pub frames: Option<Range<usize>>,
    /// The model of the floor. Default: found from the heights of the body.
    pub floor: Option<Floor>,
}

impl Options {
    /// Checks that every number is within its bounds.
    fn check(&self) -> Result<(), Error> {
        let refuse =
            |what: &'static str, value: String, expected: &'static str| Err(Error::Constant { what, value, expected });
        if let Some(unit) = self.unit_meters.filter(|unit| !axes::UNIT_METERS.contains(unit)) {
            return refuse("unit", unit.to_string(), "its length in m, from 0.000001 to 1000");
        }
        if let Some(scale) = self.scale.filter(|scale| !(0.01..=100.0).contains(scale)) {
            return refuse("scale", scale.to_string(), "a number from 0.01 to 100");
        }
        match self.floor {
            Some(floor) if floor.check().is_none() => refuse("floor", floor.to_string(), "a percentile from 0 to 100"),
            _ => Ok(()),
        }
    }
}

/// Makes a clip of the CMU humanoid V2020, with 0.03 s per frame, from a recording of any person. Also returns how well
/// the humanoid follows it.
///
/// The bodies get the orientations and directions of the bones that have a role, within the joints' ranges, by inverse
/// kinematics. Lengths are scaled by the ratio of the legs; the time is not scaled. Standing feet stay where they stand,
/// and the body is put on the floor. Velocities are central differences, as in [`import`](crate::import::import).
///
/// # Errors
/// [`Error::Recording`] for a recording that is not that of a person, or too slow, short or long; [`Error::Constant`].
pub fn retarget(recorded: &Recorded, roles: &Roles, options: &Options) -> Result<(Clip, Report), Error> {
    options.check()?;
    let source = Source::new(recorded, roles, options.frames.clone())?;
    let mut notes = Vec::new();
    let up = options.up.unwrap_or_else(|| {
        let (up, note) = up::find_up(&source);
        notes.extend(note);
        up
    });
    let leg = source.leg();
    let unit = options.unit_meters.unwrap_or_else(|| axes::find_unit(leg));
    let factor = options.scale.unwrap_or(LEG / (leg * unit));
    notes.extend(begins_apart(&source));
    let missing = source.missing();
    if !missing.is_empty() {
        let missing = missing.join(", ");
        notes.push(format!("no bone for {missing}; if the skeleton has it, say which bone it is with --bones FILE"));
    }
    let persons = source.persons(up, unit * factor);
    let mut links = align::align(&source, &source.rest(up), &persons, &mut notes);
    let contacts = feet::contacts(&persons, source.balls, DT);
    let pitches = feet::level_soles(&mut links, &persons, &contacts);
    for (side, pitch) in SIDES.iter().zip(pitches) {
        match pitch {
            None => notes.push(format!(
                "the {} foot stands flat in fewer than {} steps, so the pitch of its sole is assumed",
                side.name,
                feet::FEWEST
            )),
            Some(pitch) if pitch.abs() > TILTED => notes.push(format!(
                "the sole of the {} foot has a pitch of {pitch:.0} degrees when it stands; it is taken as level",
                side.name
            )),
            Some(_) => {}
        }
    }

    let fixed = fixed(&source);
    let solver = Solver::new(&fixed, STIFFNESS);
    let mut goals: Vec<Goal> = persons.iter().map(|person| goal(&links, person)).collect();
    let poses = solve(&solver, &goals, &persons, None);
    for (goal, hold) in goals.iter_mut().zip(feet::holds(&poses, &contacts)) {
        goal.reaches.extend(hold);
    }
    let mut poses = solve(&solver, &goals, &persons, Some(&poses));
    for bridge::Bridge { limb, step } in bridge::bridge(&mut poses) {
        let seconds = DT * step as f64;
        notes.push(format!(
            "the {limb} had two postures that fit, and goes from one to the other in 0.24 s around {seconds:.2} s"
        ));
    }

    let mut poses = in_columns(poses);
    poses.start_at_origin();
    let floor = poses.set_on_floor(options.floor);
    let motion = motion(poses, DT);
    let used = report::Used { source: &source, links: &links, persons: &persons, contacts: &contacts, fixed: &fixed };
    let report = Report {
        up,
        unit_meters: unit,
        leg_meters: leg * unit,
        scale: factor,
        frames: source.window.len(),
        frames_per_second: 1.0 / recorded.frame_seconds,
        floor: floor.to_string(),
        notes,
        ..Report::of(&used, &motion, DT)
    };
    let features = Features::of(&motion);
    let name = options.name.clone();
    Ok((Clip { name, made_from: None, model: WalkerModel::Cmu2020, dt: DT, motion, features: Some(features) }, report))
}

/// A note if the first frame in use is no part of the motion: its pelvis or upper arms are far from those of the second
/// frame, and the second frame is nearer to the third.
fn begins_apart(source: &Source) -> Option<String> {
    /// Way of the pelvis, in lengths of the leg. At 30 frames per second it is a speed of about 13 m/s.
    const WAY: f64 = 0.5;
    /// Turn of an upper arm, rad: at 30 frames per second 30 rad/s.
    const TURN: f64 = 1.0;
    let persons = source.first(3);
    let leg = source.leg();
    // 1 is far.
    let apart = |from: &Person, to: &Person| {
        let way = norm(&subtract(to.place(Role::Pelvis), from.place(Role::Pelvis))) / (WAY * leg);
        let turns = SIDES.iter().map(|side| {
            let arm = |person: &Person| person.between(side.upper_arm, side.forearm);
            angle(arm(from), arm(to)) / TURN
        });
        turns.fold(way, f64::max)
    };
    let steps: Vec<f64> = persons.windows(2).map(|pair| apart(&pair[0], &pair[1])).collect();
    let [first, others @ ..] = steps.as_slice() else { return None };
    let far = *first > 1.0 && others.iter().all(|other| *first > 2.0 * other);
    let (next, end) = (source.window.start + 1, source.window.end);
    far.then(|| {
        format!(
            "the first frame is far from the second one, as in files that begin with a T-pose; leave it out with \
             --frames {next}..{end}"
        )
    })
}

/// The joints that do not follow the recording, with their angles, rad: thumbs, and fingers without a bone.
fn fixed(source: &Source) -> Vec<(usize, f64)> {
    let mut fixed = THUMBS.to_vec();
    for (side, fingers) in SIDES.iter().zip([joint("lfingersrx"), joint("rfingersrx")]) {
        if !source.has(side.fingers) {
            fixed.push((fingers, 0.0));
        }
    }
    fixed
}

/// What a pose of the body should be like. The hip joints are where the person's are.
fn goal(links: &[Link], person: &Person) -> Goal {
    let turns: Vec<ik::Turn> = links.iter().map(|link| link.turn(person)).collect();
    let mut reaches = Vec::new();
    if let Some(pelvis) = turns.iter().find(|turn| turn.body == ROOT) {
        let hips = person.middle(Role::LeftThigh, Role::RightThigh);
        let place = subtract(hips, rotate(&pelvis.rotation, target::own_hips()));
        reaches.push(Reach { body: ROOT, from: None, place, weight: ROOT_PLACE });
    }
    for side in &SIDES {
        let place = wrist(person, side);
        reaches.push(Reach { body: side.bodies.hand, from: Some(side.bodies.humerus), place, weight: WRIST });
    }
    Goal { turns, reaches, near: ([0.0; 56], 0.0) }
}

/// Where the body's wrist is, seen from its shoulder, if its arm has the directions of the person's, m.
fn wrist(person: &Person, side: &target::Side) -> Vector {
    // From dm_control's humanoid_CMU_V2020.xml.
    const UPPER_ARM: f64 = 0.3322116;
    const FOREARM: f64 = 0.2178432 + 0.10892112;
    let upper_arm = geometry::unit(person.between(side.upper_arm, side.forearm));
    let forearm = geometry::unit(person.between(side.forearm, side.hand));
    add(scale(UPPER_ARM, upper_arm), scale(FOREARM, forearm))
}

/// The pose of every step, each from the pose of the step before; or from the poses `near` it, if they are known.
fn solve(solver: &Solver, goals: &[Goal], persons: &[Person], near: Option<&[Pose]>) -> Vec<Pose> {
    let mut poses: Vec<Pose> = Vec::with_capacity(goals.len());
    let mut last_value = 0.0;
    for (step, goal) in goals.iter().enumerate() {
        let neutral = || solver.neutral(root_place(goal), heading(persons, step));
        let mut goal = goal.clone();
        let known = near.and_then(|near| near.get(step));
        let start = match (known, poses.last()) {
            (Some(known), _) => known.clone(),
            (None, Some(last)) => {
                goal.near = (last.joints, INERTIA);
                Pose { position: root_place(&goal), ..last.clone() }
            }
            (None, None) => neutral(),
        };
        let (mut pose, value) = solver.solve(&start, &goal);
        let new = step % RETRY == 0 || value > NEW * last_value;
        last_value = value;
        if known.is_none() && value > BAD && new {
            let (other, other_value) = solver.solve(&neutral(), &goal);
            if other_value < BETTER * value {
                (pose, last_value) = (other, other_value);
            }
        }
        poses.push(pose);
    }
    poses
}

fn root_place(goal: &Goal) -> Vector {
    goal.reaches.first().map(|reach| reach.place).unwrap_or_default()
}

/// An orientation of the root near that of the person: upright hips that face the same way.
fn heading(persons: &[Person], step: usize) -> Quaternion {
    let Some(person) = persons.get(step) else { return IDENTITY };
    let lateral = person.lateral();
    multiply(about(2, lateral[1].atan2(lateral[0])), about(0, FRAC_PI_2))
}

/// The poses in the form of the import. Quaternions do not change their sign between steps.
fn in_columns(poses: Vec<Pose>) -> Poses {
    let mut columns = Poses { position: Vec::new(), quaternion: Vec::new(), joints: Vec::new() };
    let mut last = IDENTITY;
    for pose in poses {
        last = aligned(pose.quaternion, &last);
        columns.position.push(pose.position);
        columns.quaternion.push(last);
        columns.joints.push(pose.joints);
    }
    columns
}
