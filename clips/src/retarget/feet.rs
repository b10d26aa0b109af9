//! When the feet of a person stand, and where the feet of the body then stay.

use super::align::{level_sole, sole_pitch};
use super::ik::{Pose, Reach};
use super::person::Person;
use super::target::{Link, SIDES, Side};
use crate::spatial::{Vector, add, norm, scale, subtract};
use comic_experiment::statistics::{median, percentile};

/// A contact begins when the point is slower than the first limit and ends when it is faster than the second, m/s. The
/// foot that swings in a slow walk is faster than 1 m/s.
const SPEEDS: [f64; 2] = [0.2, 0.3];
/// A point that stands is at most this much above the lower of the two feet nearby in time, m.
const HEIGHT: f64 = 0.08;
/// Steps to either side in which the lower foot is looked for: half a second.
const NEARBY: usize = 16;
/// The percentile of the height of ankles above standing balls that a flat foot has. The heel is raised in a part of the
/// stance, so the lower heights are those of flat feet.
const FLAT: f64 = 25.0;
/// A higher ankle is one of a raised heel, m. This is about 7 degrees of the sole.
const RAISED: f64 = 0.015;
/// Shortest contact, steps. The foot of a sprinter stands for about 0.1 s.
const SHORTEST: usize = 3;
/// Steps over which a foot goes from its own path to where it stands: 0.18 s, less than a swing lasts.
const BLEND: usize = 6;
/// Weight of the places of the feet, 1/m²: 1 cm counts like 0.2 rad of a limb's direction.
const HOLD: f64 = 400.0;
/// Least number of steps of a flat foot for the pitch of its sole: half of the stance of a walk, 0.36 s.
pub(super) const FEWEST: usize = 12;

/// The contacts of one foot: one flag per step.
pub(super) struct Contacts {
    pub(super) ankle: Vec<bool>,
    pub(super) ball: Vec<bool>,
}

/// Finds the contacts of the left and the right foot. Of a foot without a known ball, the ankle is looked at.
pub(super) fn contacts(persons: &[Person], balls: [bool; 2], dt: f64) -> [Contacts; 2] {
    let [left, right] = &SIDES;
    let path = |role| -> Vec<Vector> { persons.iter().map(|person| person.place(role)).collect() };
    let points = [(left, balls[0]), (right, balls[1])].map(|(side, ball): (&Side, bool)| {
        let ankle = path(side.foot);
        (if ball { path(side.toes) } else { ankle.clone() }, ankle)
    });
    let lower: Vec<f64> = points[0].0.iter().zip(&points[1].0).map(|(a, b)| a[2].min(b[2])).collect();
    let floor: Vec<f64> = (0..lower.len())
        .map(|step| {
            let nearby = &lower[step.saturating_sub(NEARBY)..(step + NEARBY + 1).min(lower.len())];
            nearby.iter().copied().fold(f64::INFINITY, f64::min)
        })
        .collect();
    points.map(|(path, ankle)| {
        let low: Vec<bool> = path.iter().zip(&floor).map(|(place, floor)| place[2] - floor < HEIGHT).collect();
        let ball = slow(&path, &low, dt);
        // A foot stands flat if its ankle is not much higher above the ball than it mostly is. Else the heel is raised.
        let rise: Vec<f64> = ankle.iter().zip(&path).map(|(ankle, ball)| ankle[2] - ball[2]).collect();
        let standing = rise.iter().zip(&ball).filter(|(_, stands)| **stands).map(|(rise, _)| *rise).collect();
        let usual = percentile(standing, FLAT).unwrap_or_default();
        let flat: Vec<bool> = rise.iter().zip(&ball).map(|(rise, ball)| *ball && rise - usual < RAISED).collect();
        let ankle = slow(&ankle, &flat, dt);
        Contacts { ankle, ball }
    })
}

/// The steps in which a point is slow and may stand.
fn slow(path: &[Vector], may: &[bool], dt: f64) -> Vec<bool> {
    let last = path.len().saturating_sub(1);
    let mut slow = Vec::with_capacity(path.len());
    for (step, may) in may.iter().enumerate() {
        let (before, after) = (step.saturating_sub(1), (step + 1).min(last));
        let seconds = dt * (after - before).max(1) as f64;
        let speed = norm(&subtract(path[after], path[before])) / seconds;
        let limit = SPEEDS[usize::from(slow.last() == Some(&true))];
        slow.push(*may && speed < limit);
    }
    for (start, end) in runs(&slow) {
        if end - start < SHORTEST {
            slow[start..end].fill(false);
        }
    }
    slow
}

/// The runs of steps that are set: first, and one past the last.
fn runs(flags: &[bool]) -> Vec<(usize, usize)> {
    let mut runs: Vec<(usize, usize)> = Vec::new();
    for (step, _) in flags.iter().enumerate().filter(|(_, flag)| **flag) {
        match runs.last_mut() {
            Some((_, end)) if *end == step => *end += 1,
            _ => runs.push((step, step + 1)),
        }
    }
    runs
}

/// Levels the soles of both feet by their median pitch when they stand flat. Returns the pitches, degrees; `None` for a
/// foot that stands flat in fewer than [`FEWEST`] steps.
pub(super) fn level_soles(links: &mut [Link], persons: &[Person], contacts: &[Contacts; 2]) -> [Option<f64>; 2] {
    std::array::from_fn(|index| {
        let link = links.iter_mut().find(|link| link.body == SIDES[index].bodies.foot)?;
        let standing = persons.iter().zip(&contacts[index].ankle).filter(|(_, stands)| **stands);
        let pitches: Vec<f64> = standing.map(|(person, _)| sole_pitch(&link.wanted(person))).collect();
        if pitches.len() < FEWEST {
            return None;
        }
        let pitch = median(pitches)?;
        level_sole(link, pitch);
        Some(pitch.to_degrees())
    })
}

/// Where the feet should be at each step, m, world frame: on the way that `poses` give, but constant in a contact.
pub(super) fn holds(poses: &[Pose], contacts: &[Contacts; 2]) -> Vec<Vec<Reach>> {
    let mut holds: Vec<Vec<Reach>> = vec![Vec::new(); poses.len()];
    for (side, contacts) in SIDES.iter().zip(contacts) {
        let (mut ankles, mut balls) = (Vec::new(), Vec::new());
        for pose in poses {
            let frames = pose.frames();
            ankles.push(frames.position[side.bodies.foot]);
            balls.push(frames.position[side.bodies.toes]);
        }
        let ball = offsets(&balls, &contacts.ball);
        // The ankle moves with the ball, and stands by itself when it is slow, too.
        let carried: Vec<Vector> = ankles.iter().zip(&ball).map(|(ankle, offset)| add(*ankle, *offset)).collect();
        let ankle = offsets(&carried, &contacts.ankle);
        for (step, holds) in holds.iter_mut().enumerate() {
            let reach = |body, place| Reach { body, from: None, place, weight: HOLD };
            holds.push(reach(side.bodies.toes, add(balls[step], ball[step])));
            holds.push(reach(side.bodies.foot, add(carried[step], ankle[step])));
        }
    }
    holds
}

/// What to add to a path so that it is constant in each contact, at the mean place. The offsets fade before and after.
fn offsets(path: &[Vector], contact: &[bool]) -> Vec<Vector> {
    let mut offsets = vec![[0.0; 3]; path.len()];
    let mut weights = vec![0.0; path.len()];
    let runs = runs(contact);
    for (start, end) in &runs {
        let sum = path[*start..*end].iter().fold([0.0; 3], |sum, place| add(sum, *place));
        let mean = scale(1.0 / (end - start) as f64, sum);
        for step in *start..*end {
            offsets[step] = subtract(mean, path[step]);
        }
        let mut fade = |step: usize, distance: usize, edge: usize| {
            let share = 1.0 - distance as f64 / (BLEND + 1) as f64;
            let weight = share * share * (3.0 - 2.0 * share);
            offsets[step] = add(offsets[step], scale(weight, subtract(mean, path[edge])));
            weights[step] += weight;
        };
        for distance in 1..=BLEND {
            if let Some(step) = start.checked_sub(distance).filter(|step| !contact[*step]) {
                fade(step, distance, *start);
            }
            let step = end - 1 + distance;
            if step < path.len() && !contact[step] {
                fade(step, distance, end - 1);
            }
        }
    }
    for (offset, weight) in offsets.iter_mut().zip(weights) {
        // Between two contacts that are near in time, both fade.
        *offset = scale(1.0 / f64::max(weight, 1.0), *offset);
    }
    offsets
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_held_path_is_constant_in_a_contact_and_unchanged_far_from_it() {
        let path: Vec<Vector> = (0..60).map(|step| [0.002 * f64::from(step), 0.0, 0.0]).collect();
        let contact: Vec<bool> = (0..60).map(|step| (20..30).contains(&step)).collect();
        let offsets = offsets(&path, &contact);
        let held: Vec<Vector> = path.iter().zip(&offsets).map(|(place, offset)| add(*place, *offset)).collect();
        assert!(held[20..30].iter().all(|place| (place[0] - 0.049).abs() < 1e-12), "{held:?}");
        assert_eq!([offsets[13], offsets[36]], [[0.0; 3]; 2]);
        assert!(held.windows(2).all(|pair| (pair[1][0] - pair[0][0]).abs() < 0.006));
    }

    #[test]
    fn short_stops_are_no_contact() {
        let path: Vec<Vector> = (0..20).map(|step| [if step < 10 { 0.0 } else { f64::from(step) }, 0.0, 0.0]).collect();
        let slow = slow(&path, &[true; 20], 0.03);
        assert_eq!(runs(&slow), [(0, 9)]);
        assert_eq!(runs(&[true, false, true, true]), [(0, 1), (2, 4)]);
    }
}
