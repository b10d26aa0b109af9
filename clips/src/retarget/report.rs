//! How well the humanoid follows a recording.

use std::fmt;

use serde::Serialize;

use super::axes::{Axis, unit_name};
use super::feet::Contacts;
use super::geometry::{angle, column, product, transposed};
use super::person::{Person, Source};
use super::roles::Role;
use super::target::{Link, SIDES, hips};
use crate::body::{Frames, body};
use crate::clip::Motion;
use crate::humanoid::{JOINT_RANGES, JOINTS};
use crate::spatial::{norm, subtract};

/// A joint is at its limit if it is nearer than this, rad.
const AT_LIMIT: f64 = 1e-3;
/// Joints that are less often at a limit are not listed.
const SELDOM: f64 = 0.01;

/// What a retargeting found and how well it did.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// The axis of the file's world that points up.
    pub up: Axis,
    /// The file's unit of length, m.
    pub unit_meters: f64,
    /// Length of the subject's leg from hip joint to ankle, m.
    pub leg_meters: f64,
    /// Factor for all lengths, after the unit: V2020's leg divided by the subject's.
    pub scale: f64,
    /// Recorded frames in use.
    pub frames: usize,
    /// Recorded frames per second.
    pub frames_per_second: f64,
    /// Steps of the clip.
    pub steps: usize,
    /// Duration of the clip, s.
    pub seconds: f64,
    /// The floor, in the form of the option.
    pub floor: String,
    /// The bodies that follow a bone.
    pub bones: Vec<BoneError>,
    /// Places seen from the middle of the hip joints, compared with the scaled recording.
    pub places: Vec<PlaceError>,
    /// Joints that are at a limit of their range in more than 1 % of the steps.
    pub limits: Vec<AtLimit>,
    /// Height of the lowest point of the body over all steps, mm. The floor is at 0.
    pub lowest_mm: f64,
    /// The greatest height of the lowest point, mm: in flight, or where the floor was not found well.
    pub highest_mm: f64,
    /// Share of steps in which at least one foot stands.
    pub standing: f64,
    /// How far standing feet slide, mm per step: mean.
    pub mean_slide_mm: f64,
    /// The same: largest.
    pub largest_slide_mm: f64,
    /// The joint with the largest speed.
    pub fastest_joint: String,
    /// Its speed, rad/s.
    pub fastest_joint_speed: f64,
    /// When, s.
    pub fastest_joint_seconds: f64,
    /// What a reader should know.
    pub notes: Vec<String>,
}

/// The angle between a body and what the recording says.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BoneError {
    /// The bone in the file.
    pub bone: String,
    /// Its role.
    pub role: &'static str,
    /// For a limb the angle counts between the directions, else between the orientations.
    pub limb: bool,
    /// Mean over the steps, degrees.
    pub mean_degrees: f64,
    /// Largest, degrees.
    pub largest_degrees: f64,
}

/// The distance between a place and what the recording says.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PlaceError {
    /// Which place.
    pub place: String,
    /// Mean over the steps, mm.
    pub mean_mm: f64,
    /// Largest, mm.
    pub largest_mm: f64,
}

/// A joint that is often at a limit of its range.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AtLimit {
    /// The joint.
    pub joint: &'static str,
    /// Share of the steps.
    pub share: f64,
}

/// Mean and maximum.
#[derive(Clone, Copy, Default)]
struct Tally {
    sum: f64,
    largest: f64,
    count: f64,
}

impl Tally {
    fn of(values: impl Iterator<Item = f64>) -> Self {
        values.fold(Self::default(), |tally, value| Self {
            sum: tally.sum + value,
            largest: tally.largest.max(value),
            count: tally.count + 1.0,
        })
    }

    fn mean(&self) -> f64 {
        self.sum / self.count.max(1.0)
    }
}

/// What a retargeting used.
pub(super) struct Used<'a> {
    pub(super) source: &'a Source<'a>,
    pub(super) links: &'a [Link],
    pub(super) persons: &'a [Person],
    pub(super) contacts: &'a [Contacts; 2],
    /// Joints that do not follow the recording.
    pub(super) fixed: &'a [(usize, f64)],
}

impl Report {
    /// Compares a motion with the recording. The fields that do not follow from it are left at 0.
    pub(super) fn of(used: &Used, motion: &Motion, dt: f64) -> Self {
        let poses = motion.position.iter().zip(&motion.quaternion).zip(&motion.joints);
        let frames: Vec<Frames> = poses.map(|((place, turn), joints)| Frames::of(place, turn, joints)).collect();
        let heights: Vec<f64> = frames.iter().map(|frames| 1000.0 * frames.lowest().0).collect();
        let (standing, slide) = sliding(used.contacts, &frames);
        let (fastest_joint, fastest_joint_speed, step) = fastest(motion);
        Self {
            up: Axis::Z,
            unit_meters: 0.0,
            leg_meters: 0.0,
            scale: 0.0,
            frames: 0,
            frames_per_second: 0.0,
            steps: motion.position.len(),
            seconds: dt * motion.position.len() as f64,
            floor: String::new(),
            bones: bones(used, &frames),
            places: places(used, &frames),
            limits: limits(motion, used.fixed),
            lowest_mm: heights.iter().copied().fold(f64::INFINITY, f64::min),
            highest_mm: heights.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            standing,
            mean_slide_mm: slide.mean(),
            largest_slide_mm: slide.largest,
            fastest_joint,
            fastest_joint_speed,
            fastest_joint_seconds: dt * step as f64,
            notes: Vec::new(),
        }
    }
}

fn bones(used: &Used, frames: &[Frames]) -> Vec<BoneError> {
    let error = |link: &Link| {
        let tally = Tally::of(frames.iter().zip(used.persons).map(|(frames, person)| {
            let (has, wanted) = (&frames.rotation[link.body], link.wanted(person));
            match link.is_limb() {
                true => angle(column(has, 1), column(&wanted, 1)).to_degrees(),
                false => {
                    let between = product(&transposed(has), &wanted);
                    let [[a, b, c], [d, e, f], [g, h, i]] = between;
                    norm(&[h - f, c - g, d - b]).atan2(a + e + i - 1.0).to_degrees()
                }
            }
        }));
        BoneError {
            bone: used.source.name(link.role).into(),
            role: link.role.name(),
            limb: link.is_limb(),
            mean_degrees: tally.mean(),
            largest_degrees: tally.largest,
        }
    };
    used.links.iter().map(error).collect()
}

fn places(used: &Used, frames: &[Frames]) -> Vec<PlaceError> {
    let mut points: Vec<(String, Role, usize)> = Vec::new();
    for side in &SIDES {
        points.push((format!("{} wrist", side.name), side.hand, side.bodies.hand));
        points.push((format!("{} ankle", side.name), side.foot, side.bodies.foot));
    }
    if used.source.has(Role::Head) {
        points.push(("head".into(), Role::Head, body("head")));
    }
    let error = |(place, role, body): (String, Role, usize)| {
        let tally = Tally::of(frames.iter().zip(used.persons).map(|(frames, person)| {
            let hips = hips(frames);
            let wanted = subtract(person.place(role), person.middle(Role::LeftThigh, Role::RightThigh));
            1000.0 * norm(&subtract(subtract(frames.position[body], hips), wanted))
        }));
        PlaceError { place, mean_mm: tally.mean(), largest_mm: tally.largest }
    };
    points.into_iter().map(error).collect()
}

fn limits(motion: &Motion, fixed: &[(usize, f64)]) -> Vec<AtLimit> {
    let mut limits: Vec<AtLimit> = Vec::new();
    for (joint, [low, high]) in JOINT_RANGES.into_iter().enumerate() {
        if fixed.iter().any(|(other, _)| *other == joint) {
            continue;
        }
        let at = |joints: &&[f64; 56]| joints[joint] < low + AT_LIMIT || joints[joint] > high - AT_LIMIT;
        let share = motion.joints.iter().filter(at).count() as f64 / motion.joints.len().max(1) as f64;
        if share > SELDOM {
            limits.push(AtLimit { joint: JOINTS[joint], share });
        }
    }
    limits.sort_by(|a, b| b.share.total_cmp(&a.share));
    limits
}

/// Share of steps with a standing foot, and how far the balls of standing feet move along the floor, mm per step.
fn sliding(contacts: &[Contacts; 2], frames: &[Frames]) -> (f64, Tally) {
    let stands = |side: usize, step: usize| contacts[side].ball.get(step) == Some(&true);
    let standing = (0..frames.len()).filter(|step| stands(0, *step) || stands(1, *step)).count();
    let mut slides = Vec::new();
    for (index, side) in SIDES.iter().enumerate() {
        for (step, pair) in frames.windows(2).enumerate() {
            if stands(index, step) && stands(index, step + 1) {
                let [x, y, _] = subtract(pair[1].position[side.bodies.toes], pair[0].position[side.bodies.toes]);
                slides.push(1000.0 * f64::hypot(x, y));
            }
        }
    }
    (standing as f64 / frames.len().max(1) as f64, Tally::of(slides.into_iter()))
}

/// The joint with the largest speed, the speed in rad/s, and the step.
fn fastest(motion: &Motion) -> (String, f64, usize) {
    let mut fastest = (0, 0.0, 0);
    for (step, speeds) in motion.joints_velocity.iter().enumerate() {
        for (joint, speed) in speeds.iter().enumerate() {
            if speed.abs() > fastest.1 {
                fastest = (joint, speed.abs(), step);
            }
        }
    }
    (JOINTS[fastest.0].into(), fastest.1, fastest.2)
}

impl fmt::Display for Report {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            out,
            "{} frames at {:.2} per second: {} steps of 0.03 s, {:.2} s",
            self.frames, self.frames_per_second, self.steps, self.seconds
        )?;
        writeln!(
            out,
            "axes and lengths: {} is up, unit {}, leg {:.3} m, lengths times {:.3}, floor {}",
            self.up,
            unit_name(self.unit_meters),
            self.leg_meters,
            self.scale,
            self.floor
        )?;
        writeln!(out, "angles to the recording, degrees (limbs: direction only):")?;
        for bone in &self.bones {
            let BoneError { bone, role, mean_degrees, largest_degrees, .. } = bone;
            writeln!(out, "  {role:16} mean {mean_degrees:5.1}  largest {largest_degrees:5.1}  ({bone})")?;
        }
        writeln!(out, "places seen from the hips, distance to the scaled recording, mm:")?;
        for PlaceError { place, mean_mm, largest_mm } in &self.places {
            writeln!(out, "  {place:16} mean {mean_mm:5.0}  largest {largest_mm:5.0}")?;
        }
        match self.limits.is_empty() {
            true => writeln!(out, "no joint is at a limit of its range")?,
            false => {
                let list = self.limits.iter().map(|limit| format!("{} {:.0} %", limit.joint, 100.0 * limit.share));
                writeln!(
                    out,
                    "joints at a limit of their range, share of steps: {}",
                    list.collect::<Vec<_>>().join(", ")
                )?;
            }
        }
        writeln!(
            out,
            "floor: the lowest point of the body is between {:.1} and {:.1} mm",
            self.lowest_mm, self.highest_mm
        )?;
        writeln!(
            out,
            "feet: one stands in {:.0} % of the steps and slides by {:.1} mm per step on average, {:.1} mm at most",
            100.0 * self.standing,
            self.mean_slide_mm,
            self.largest_slide_mm
        )?;
        write!(
            out,
            "fastest joint: {} with {:.1} rad/s at {:.2} s",
            self.fastest_joint, self.fastest_joint_speed, self.fastest_joint_seconds
        )?;
        for note in &self.notes {
            write!(out, "\nnote: {note}")?;
        }
        Ok(())
    }
}
