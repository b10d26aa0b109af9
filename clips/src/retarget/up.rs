//! Finds the axis that points up.

use super::align::NEAR;
use super::axes::Axis;
use super::geometry::{angle, unit};
use super::person::Source;
use super::roles::Role;
use crate::spatial::{Vector, add, dot, subtract};

/// Cosine of the angle to an axis below which a person is upright along it: 45 degrees. No other axis is then nearer.
const UPRIGHT: f64 = std::f64::consts::FRAC_1_SQRT_2;

/// The axis that points up in the file's world, and a note if that is not certain.
///
/// It is the axis along which the person is upright in most of the frames in use, from the feet to the shoulders. If there
/// is no such axis, it is that of the rest pose. A crawl or a handstand along one axis looks like a person who stands in
/// another file, so a rest pose along another axis is mentioned.
pub(super) fn find_up(source: &Source) -> (Axis, Option<String>) {
    let directions: Vec<Vector> = source
        .samples()
        .map(|person| {
            let feet = person.middle(Role::LeftFoot, Role::RightFoot);
            unit(subtract(person.middle(Role::LeftUpperArm, Role::RightUpperArm), feet))
        })
        .collect();
    let moving = Axis::nearest(&directions.iter().fold([0.0; 3], |sum, direction| add(sum, *direction)));
    let upright = directions.iter().filter(|direction| dot(direction, &moving.direction()) > UPRIGHT).count();
    let clear = 2 * upright > directions.len();
    match (clear, resting(source)) {
        (true, None) => (moving, None),
        (_, Some(rest)) if rest == moving => (moving, None),
        (true, Some(rest)) => {
            let note = format!(
                "up is {moving}, as the motion shows, but the rest pose stands along {rest}; give --up {rest} if the \
                 result lies or stands on its head"
            );
            (moving, Some(note))
        }
        (false, Some(rest)) => {
            let note = format!(
                "up is {rest}, as the rest pose shows, because the motion is upright along no axis for most of the time; \
                 give --up if the result lies"
            );
            (rest, Some(note))
        }
        (false, None) => {
            let note = format!(
                "up is {moving}, but the motion is upright along no axis for most of the time; give --up if the result lies"
            );
            (moving, Some(note))
        }
    }
}

/// The axis along which the rest pose stands, if it is a person who stands along an axis of the world.
fn resting(source: &Source) -> Option<Axis> {
    let rest = source.rest(Axis::Z);
    let axis = Axis::nearest(&rest.trunk());
    (source.rest_in_world() && rest.stands() && angle(rest.trunk(), axis.direction()) < NEAR).then_some(axis)
}
