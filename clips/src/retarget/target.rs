//! Which body of the humanoid follows which part of a person, and how closely.

use super::geometry::{column, frame, product, transposed};
use super::ik::Turn;
use super::person::{Person, Source};
use super::roles::Role;
use crate::body::{BODIES, Frames, ROOT, body};
use crate::spatial::{Matrix, Vector, add as plus, matrix, scale, subtract};

/// The roles and bodies of one side.
pub(super) struct Side {
    pub(super) name: &'static str,
    pub(super) clavicle: Role,
    pub(super) upper_arm: Role,
    pub(super) forearm: Role,
    pub(super) hand: Role,
    pub(super) fingers: Role,
    pub(super) thigh: Role,
    pub(super) shin: Role,
    pub(super) foot: Role,
    pub(super) toes: Role,
    pub(super) bodies: SideBodies,
}

/// Indices of the bodies of one side. The body `hand` begins at the wrist; the body `wrist` is the half of the forearm
/// that rolls.
pub(super) struct SideBodies {
    pub(super) clavicle: usize,
    pub(super) humerus: usize,
    pub(super) radius: usize,
    pub(super) wrist: usize,
    pub(super) hand: usize,
    pub(super) fingers: usize,
    pub(super) femur: usize,
    pub(super) tibia: usize,
    pub(super) foot: usize,
    pub(super) toes: usize,
}

/// Left, then right.
pub(super) const SIDES: [Side; 2] = [
    Side {
        name: "left",
        clavicle: Role::LeftClavicle,
        upper_arm: Role::LeftUpperArm,
        forearm: Role::LeftForearm,
        hand: Role::LeftHand,
        fingers: Role::LeftFingers,
        thigh: Role::LeftThigh,
        shin: Role::LeftShin,
        foot: Role::LeftFoot,
        toes: Role::LeftToes,
        bodies: SideBodies {
            clavicle: body("lclavicle"),
            humerus: body("lhumerus"),
            radius: body("lradius"),
            wrist: body("lwrist"),
            hand: body("lhand"),
            fingers: body("lfingers"),
            femur: body("lfemur"),
            tibia: body("ltibia"),
            foot: body("lfoot"),
            toes: body("ltoes"),
        },
    },
    Side {
        name: "right",
        clavicle: Role::RightClavicle,
        upper_arm: Role::RightUpperArm,
        forearm: Role::RightForearm,
        hand: Role::RightHand,
        fingers: Role::RightFingers,
        thigh: Role::RightThigh,
        shin: Role::RightShin,
        foot: Role::RightFoot,
        toes: Role::RightToes,
        bodies: SideBodies {
            clavicle: body("rclavicle"),
            humerus: body("rhumerus"),
            radius: body("rradius"),
            wrist: body("rwrist"),
            hand: body("rhand"),
            fingers: body("rfingers"),
            femur: body("rfemur"),
            tibia: body("rtibia"),
            foot: body("rfoot"),
            toes: body("rtoes"),
        },
    },
];

/// The bodies of the trunk, from the pelvis to the head.
pub(super) const TRUNK: [usize; 7] =
    [ROOT, body("lowerback"), body("upperback"), body("thorax"), body("lowerneck"), body("upperneck"), body("head")];

/// A body that follows a part of a person.
#[derive(Clone, Debug)]
pub(super) struct Link {
    pub(super) role: Role,
    pub(super) body: usize,
    /// Weights of the directions of the body's x, y and z axes. Limbs lie along −y, so the weight of y is that of the
    /// limb's direction, and the others are that of its roll.
    weights: Vector,
    /// The body's orientation in the frame of the bone.
    pub(super) alignment: Matrix,
}

// All weights are relative to 1 for the direction of a limb. They order what counts when a pose cannot have all of it. They
// are chosen so that CMU's recordings give nearly the angles of the import: `tests/retarget_asf.rs` compares
// three of them.

/// The direction and the roll count alike.
const WHOLE: Vector = [0.5, 0.5, 0.5];
/// The roll of a bent limb also follows from the direction of the next limb.
const LIMB: Vector = [0.1, 1.0, 0.1];
/// A hinge cannot roll, so only the direction counts.
const HINGE: Vector = [0.0, 1.0, 0.0];
/// Pelvis, chest and head must not turn to help an arm that is at its limits.
const TRUNK_WEIGHT: Vector = [4.0, 4.0, 4.0];
/// The spine and the neck of a skeleton have joints at other places than the body, so the pelvis, the bone that carries
/// the arms, and the head count more.
const BETWEEN: Vector = [0.1, 0.1, 0.1];
/// The hand also gives the roll of the forearm.
const HAND: Vector = [0.2, 0.2, 0.2];
/// The floor needs the direction of a foot more than its roll.
const FOOT: Vector = [0.1, 0.5, 0.1];
/// Parts of the body that move little.
const SMALL: Vector = [0.1, 0.1, 0.1];

/// The links of a skeleton, from the pelvis outwards. They are aligned by some poses with the bodies' orientations in
/// them; if there are several poses, by the mean.
pub(super) fn links(source: &Source, poses: &[(&Person, [Matrix; BODIES])]) -> Vec<Link> {
    let mut links = Vec::new();
    let mut add = |role: Role, body: usize, weights: Vector| {
        if source.has(role) {
            let (mut x, mut y) = ([0.0; 3], [0.0; 3]);
            for (person, bodies) in poses {
                let own = product(&transposed(&matrix(person.turn(role))), &bodies[body]);
                x = plus(x, column(&own, 0));
                y = plus(y, column(&own, 1));
            }
            links.push(Link { role, body, weights, alignment: frame(x, y) });
        }
    };
    let [root, lower_back, upper_back, thorax, lower_neck, upper_neck, head] = TRUNK;
    add(Role::Pelvis, root, TRUNK_WEIGHT);
    // The last bone of the spine carries the arms, as the thorax does.
    let spine: Vec<Role> =
        [Role::Spine, Role::Chest, Role::UpperChest].into_iter().filter(|role| source.has(*role)).collect();
    match spine[..] {
        [a, b, c] => {
            add(a, lower_back, BETWEEN);
            add(b, upper_back, BETWEEN);
            add(c, thorax, TRUNK_WEIGHT);
        }
        [a, b] => {
            add(a, lower_back, BETWEEN);
            add(b, thorax, TRUNK_WEIGHT);
        }
        [a] => add(a, thorax, TRUNK_WEIGHT),
        _ => {}
    }
    match (source.has(Role::Head), source.has(Role::UpperNeck)) {
        (true, true) => {
            add(Role::Neck, lower_neck, BETWEEN);
            add(Role::UpperNeck, upper_neck, BETWEEN);
            add(Role::Head, head, WHOLE);
        }
        (true, false) => {
            add(Role::Neck, upper_neck, BETWEEN);
            add(Role::Head, head, WHOLE);
        }
        _ => add(Role::Neck, head, WHOLE),
    }
    for side in &SIDES {
        add(side.clavicle, side.bodies.clavicle, SMALL);
        add(side.upper_arm, side.bodies.humerus, LIMB);
        add(side.forearm, side.bodies.radius, HINGE);
        match source.has(side.hand) {
            true => add(side.hand, side.bodies.hand, HAND),
            // Without a hand, the forearm rolls.
            false => add(side.forearm, side.bodies.wrist, SMALL),
        }
        add(side.fingers, side.bodies.fingers, SMALL);
        add(side.thigh, side.bodies.femur, LIMB);
        add(side.shin, side.bodies.tibia, HINGE);
        add(side.foot, side.bodies.foot, FOOT);
        add(side.toes, side.bodies.toes, SMALL);
    }
    links
}

impl Link {
    /// The orientation that the body should have.
    pub(super) fn wanted(&self, person: &Person) -> Matrix {
        product(&matrix(person.turn(self.role)), &self.alignment)
    }

    pub(super) fn turn(&self, person: &Person) -> Turn {
        Turn { body: self.body, rotation: self.wanted(person), weights: self.weights }
    }

    /// Whether only the direction of the limb counts for the report: its roll follows from other parts.
    pub(super) fn is_limb(&self) -> bool {
        self.weights[1] > self.weights[0]
    }
}

/// The middle of the body's hip joints, m.
pub(super) fn hips(frames: &Frames) -> Vector {
    let [left, right] = &SIDES;
    scale(0.5, plus(frames.position[left.bodies.femur], frames.position[right.bodies.femur]))
}

/// The same, m, in the frame of the body's root.
pub(super) fn own_hips() -> Vector {
    let zero = Frames::zero();
    subtract(hips(&zero), zero.position[ROOT])
}
