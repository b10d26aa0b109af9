//! How the humanoid's bodies lie in the bones of a skeleton.
//!
//! In its rest pose a skeleton stands upright with straight limbs, mostly as a T. The body in that pose has a straight
//! trunk, limbs in the skeleton's directions with the least turn from the body's own T, and soles on the floor.

use super::axes::Axis;
use super::geometry::{across, angle, between, column, frame, from_columns, product, transposed, unit};
use super::person::{POINTS, Person, Source};
use super::target::{Link, SIDES, SideBodies, TRUNK, links};
use crate::body::{BODIES, Frames, ROOT};
use crate::import::SOLE;
use crate::spatial::{
    Matrix, Vector, about, about_vector, add, cross, dot, matrix, norm, rotate, scale, subtract, unrotate,
};

/// The trunk of a rest pose is nearer to a coordinate axis than this, rad. From the hip joints to the shoulders it leans a
/// little; two axes are 1.6 rad apart.
pub(super) const NEAR: f64 = 0.4;
/// Without a rest pose, one step in this many is used: the straightest ones. In a walk that is both of its halves.
const STRAIGHTEST: usize = 10;
/// A leg that is farther from upright, seen from the front, is spread, rad. CMU's skeletons have 20 degrees. Most
/// others have upright legs.
const SPREAD: f64 = 0.2;
/// Two limbs that meet at a larger angle than this show the axis of their hinge, rad. The error of the axis is that of the
/// directions, divided by the sine of this angle.
const BENT: f64 = 0.4;
/// Least number of steps with a bent limb: 0.3 s.
const FEWEST: usize = 10;
/// The axes of the hinge in these steps have a mean that is at least this long, if they agree: they are then about 37
/// degrees from it, or nearer.
const AGREES: f64 = 0.8;

/// Finds the links of a skeleton. If its rest pose is not that of a person, the alignment comes from the steps in which
/// the person stands straightest, and a note is added.
pub(super) fn align(source: &Source, rest: &Person, persons: &[Person], notes: &mut Vec<String>) -> Vec<Link> {
    let mut poses = Vec::new();
    if rest.stands() {
        poses.push((rest, bodies(source, rest, upright(rest, true))));
    } else {
        let mut straight: Vec<(f64, &Person)> =
            persons.iter().map(|person| (bend(person, source.balls), person)).collect();
        straight.sort_by(|a, b| a.0.total_cmp(&b.0));
        straight.truncate(persons.len().div_ceil(STRAIGHTEST));
        let worst = straight.last().map_or(0.0, |(bend, _)| bend.sqrt().to_degrees());
        notes.push(format!(
            "the skeleton's rest pose is not a person who stands, so the bones are aligned by the straightest {} poses, \
             whose bends are at most {worst:.0} degrees (root of the sum of squares); a recording that begins standing \
             straight is aligned best",
            straight.len()
        ));
        poses.extend(straight.iter().map(|(_, person)| (*person, bodies(source, person, upright(person, false)))));
    }
    let mut links = links(source, &poses);
    for side in &SIDES {
        let arm = [(side.upper_arm, side.bodies.humerus), (side.forearm, side.bodies.radius)];
        let leg = [(side.thigh, side.bodies.femur), (side.shin, side.bodies.tibia)];
        for ([(inner, inner_body), (outer, outer_body)], end) in [(arm, side.hand), (leg, side.foot)] {
            let limbs: Vec<(Vector, Vector)> =
                persons.iter().map(|person| (person.between(inner, outer), person.between(outer, end))).collect();
            for (body, role, pick) in [(inner_body, inner, 0), (outer_body, outer, 1)] {
                if let Some(link) = links.iter_mut().find(|link| link.body == body) {
                    let turns = persons.iter().map(|person| matrix(person.turn(role)));
                    let backwards = roll(link, turns.zip(&limbs), pick);
                    if backwards && pick == 0 {
                        notes.push(format!(
                            "bone `{}` bends backwards against the next one: are left and right exchanged?",
                            source.name(role)
                        ));
                    }
                }
            }
        }
    }
    links
}

/// Rolls a limb's body so that its x axis is the axis of knee or elbow, which bent limbs show, and its y axis is along
/// the limb. `pick` says which of the two limbs it is. Returns whether the axis is opposite to that of the rest pose; then
/// the roll stays.
fn roll<'a>(link: &mut Link, steps: impl Iterator<Item = (Matrix, &'a (Vector, Vector))>, pick: usize) -> bool {
    let (mut axis, mut along, mut weight, mut count) = ([0.0; 3], [0.0; 3], 0.0, 0);
    for (turn, (inner, outer)) in steps {
        let (inner, outer) = (unit(*inner), unit(*outer));
        let hinge = cross(inner, outer);
        let sine = norm(&hinge);
        along = add(along, unrotate(&turn, if pick == 0 { inner } else { outer }));
        if sine > BENT.sin() {
            // The direction of `hinge` is known as well as its length is large.
            axis = add(axis, scale(sine, unrotate(&turn, unit(hinge))));
            weight += sine;
            count += 1;
        }
    }
    let y = scale(-1.0, unit(along));
    let found = count >= FEWEST && norm(&axis) > AGREES * weight;
    let aligned = product(&between(column(&link.alignment, 1), y), &link.alignment);
    let backwards = found && dot(&axis, &column(&aligned, 0)) < 0.0;
    link.alignment = if found && !backwards { frame(axis, y) } else { aligned };
    backwards
}

/// How far a pose is from standing straight and looking forward: a sum of squared angles, rad². A foot whose ball is not
/// known does not count.
fn bend(person: &Person, balls: [bool; 2]) -> f64 {
    let up = unit(person.trunk());
    let lateral = person.lateral();
    let shoulders = person.between(SIDES[1].upper_arm, SIDES[0].upper_arm);
    let forward = cross(lateral, up);
    let mut sum = angle(up, [0.0, 0.0, 1.0]).powi(2) + angle(lateral, shoulders).powi(2);
    for (side, ball) in SIDES.iter().zip(balls) {
        let thigh = person.between(side.thigh, side.shin);
        sum += angle(thigh, scale(-1.0, up)).powi(2);
        sum += angle(thigh, person.between(side.shin, side.foot)).powi(2);
        let arm = person.between(side.upper_arm, side.forearm);
        sum += 0.25 * angle(arm, person.between(side.forearm, side.hand)).powi(2);
        if ball {
            let foot = person.between(side.foot, side.toes);
            sum += 0.25 * angle([foot[0], foot[1], 0.0], [forward[0], forward[1], 0.0]).powi(2);
        }
    }
    sum
}

/// The direction of the body's y axis in a standing pose. In a rest pose it is the coordinate axis nearest to the trunk,
/// if that is near. Else it follows from the trunk: the body's shoulders are not quite above its hip joints.
fn upright(person: &Person, rests: bool) -> Vector {
    let trunk = person.trunk();
    // A root that turns the skeleton upright leaves its rest pose along another axis.
    let axis = Axis::nearest(&trunk).direction();
    if rests && angle(trunk, axis) < NEAR {
        return axis;
    }
    let zero = Frames::zero().position;
    let middle = |body: fn(&SideBodies) -> usize| {
        let [left, right] = SIDES.each_ref().map(|side| zero[body(&side.bodies)]);
        scale(0.5, add(left, right))
    };
    let [_, y, z] = subtract(middle(|bodies| bodies.humerus), middle(|bodies| bodies.femur));
    let lean = matrix(about_vector(unit(person.lateral()), -z.atan2(y)));
    rotate(&lean, trunk)
}

/// The orientations of all bodies when the person is in this standing pose, and `up` is up.
fn bodies(source: &Source, person: &Person, up: Vector) -> [Matrix; BODIES] {
    let zero = Frames::zero().rotation;
    let lateral = unit(person.lateral());
    let up = unit(across(up, lateral));
    // The root's axes: x to the left, y up, z forward.
    let root = from_columns([lateral, up, cross(lateral, up)]);
    let mut bodies: [Matrix; BODIES] = std::array::from_fn(|body| product(&root, &zero[body]));
    for trunk in TRUNK {
        bodies[trunk] = root;
    }
    // Turns the body by the least angle that gives its limb, which lies along −y, the person's direction.
    let mut aim = |carrier: usize, body: usize, direction: Vector| {
        let carried = product(&bodies[carrier], &product(&transposed(&zero[carrier]), &zero[body]));
        let y = scale(-1.0, unit(direction));
        bodies[body] = product(&between(column(&carried, 1), y), &carried);
    };
    for side in &SIDES {
        let own = &side.bodies;
        aim(ROOT, own.humerus, person.between(side.upper_arm, side.forearm));
        aim(own.humerus, own.radius, person.between(side.forearm, side.hand));
        aim(ROOT, own.femur, person.between(side.thigh, side.shin));
        aim(own.femur, own.tibia, person.between(side.shin, side.foot));
    }
    for (side, ball) in SIDES.iter().zip(source.balls) {
        let own = &side.bodies;
        let forward = column(&root, 2);
        // Seen from the front, a sole is level under a leg that is upright, and turns with a leg that is spread.
        let shin = person.between(side.shin, side.foot);
        let spread = scale(-1.0, unit(across(shin, forward)));
        let above = if angle(spread, up) < SPREAD { up } else { spread };
        let foot = unit(person.between(side.foot, side.toes));
        let points = ball && norm(&across(foot, above)) > POINTS;
        let heading = if points { foot } else { forward };
        bodies[own.foot] = level_foot(heading, above);
        bodies[own.toes] = bodies[own.foot];
        for (carrier, body) in [(own.radius, own.wrist), (own.wrist, own.hand), (own.hand, own.fingers)] {
            bodies[body] = product(&bodies[carrier], &product(&transposed(&zero[carrier]), &zero[body]));
        }
    }
    bodies
}

/// The orientation of a foot that stands on its sole and points in a direction.
fn level_foot(heading: Vector, up: Vector) -> Matrix {
    let heading = unit(across(heading, up));
    let down = scale(-1.0, up);
    let (x, sole) = ([1.0, 0.0, 0.0], unit(SOLE));
    let own = from_columns([x, sole, cross(x, sole)]);
    let world = from_columns([cross(heading, down), heading, down]);
    product(&world, &transposed(&own))
}

/// The pitch of a sole, rad; positive if the toes point up.
pub(super) fn sole_pitch(foot: &Matrix) -> f64 {
    rotate(foot, unit(SOLE))[2].clamp(-1.0, 1.0).asin()
}

/// Turns the sole of a foot's link so that a sole of that pitch is level.
pub(super) fn level_sole(link: &mut Link, pitch: f64) {
    // In the foot's frame, a positive turn about x lowers the toes, which are at −y.
    link.alignment = product(&link.alignment, &matrix(about(0, pitch)));
}
