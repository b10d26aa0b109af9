//! Fits arms whose angles are outside the ranges: finds the allowed angles with the nearest elbow and wrist positions.
//!
//! In the V2020 body `rhumerusrz` has the range of the left arm instead of its mirror image. A hanging right arm is
//! outside this range. With clamped angles the wrist is about 18 cm away from its recorded position.

use super::angles::{excess, wrap};
use crate::body::{Frames, body, joint};
use crate::humanoid::JOINT_RANGES;
use crate::spatial::{IDENTITY, Vector, cross, dot, subtract};

/// Weight of the distance between an angle and the recorded angle, relative to the distance of a point, m/rad.
pub(crate) const REGULARISATION: f64 = 0.2;
/// If the smallest eigenvalue of the Hessian is not above this, the Gauss-Newton matrix replaces the Hessian.
const CONVEX: f64 = 1e-3;
const NEWTON_STEPS: usize = 200;
const BOX_STEPS: usize = 2000;
/// The search ends with a step smaller than this, rad.
const CONVERGED: f64 = 1e-12;
/// Steps smaller than this are taken fully, rad: they are near the optimum.
const NEAR: f64 = 1e-6;

type Six = [f64; 6];
type Square = [[f64; 6]; 6];

/// One arm's hinges, from the trunk outwards, and the bodies at elbow and wrist.
struct Arm {
    joints: [usize; 6],
    /// The body that each hinge turns.
    turns: [usize; 6],
    elbow: usize,
    wrist: usize,
    /// The hinge that rolls the forearm.
    roll: usize,
}

const ARMS: [Arm; 2] = [
    Arm {
        joints: [
            joint("lclaviclerz"),
            joint("lclaviclery"),
            joint("lhumerusrz"),
            joint("lhumerusry"),
            joint("lhumerusrx"),
            joint("lradiusrx"),
        ],
        turns: [
            body("lclavicle"),
            body("lclavicle"),
            body("lhumerus"),
            body("lhumerus"),
            body("lhumerus"),
            body("lradius"),
        ],
        elbow: body("lradius"),
        wrist: body("lwrist"),
        roll: joint("lwristry"),
    },
    Arm {
        joints: [
            joint("rclaviclerz"),
            joint("rclaviclery"),
            joint("rhumerusrz"),
            joint("rhumerusry"),
            joint("rhumerusrx"),
            joint("rradiusrx"),
        ],
        turns: [
            body("rclavicle"),
            body("rclavicle"),
            body("rhumerus"),
            body("rhumerus"),
            body("rhumerus"),
            body("rradius"),
        ],
        elbow: body("rradius"),
        wrist: body("rwrist"),
        roll: joint("rwristry"),
    },
];

/// Fits both arms of one frame. `joints` is the clamped copy of `free` (both rad). If an angle of an arm in `free` is
/// outside its range, `joints` gets the angles whose elbow and wrist are nearest to those of `free`, and the roll of
/// the forearm whose hand is nearest.
pub(crate) fn fit(free: &[f64; 56], joints: &mut [f64; 56], regularisation: f64) {
    for arm in &ARMS {
        let wanted = arm.joints.map(|joint| free[joint]);
        if arm.joints.iter().zip(wanted).all(|(joint, angle)| excess(angle, *joint) <= 0.0) {
            continue;
        }
        let solved = Problem::new(arm, wanted, regularisation).solve();
        joints[arm.roll] = arm.roll(&wanted, free[arm.roll], &solved);
        for (joint, angle) in arm.joints.into_iter().zip(solved) {
            joints[joint] = angle;
        }
    }
}

impl Arm {
    fn frames(&self, angles: &Six, roll: f64) -> Frames {
        let mut joints = [0.0; 56];
        for (joint, angle) in self.joints.into_iter().zip(angles) {
            joints[joint] = *angle;
        }
        joints[self.roll] = roll;
        Frames::of(&[0.0; 3], &IDENTITY, &joints)
    }

    /// The roll of the forearm (about the wrist's y axis, rad) for which the hand of the `solved` arm has the
    /// orientation nearest to the wanted hand.
    fn roll(&self, wanted: &Six, wanted_roll: f64, solved: &Six) -> f64 {
        let wanted = self.frames(wanted, wanted_roll).rotation[self.wrist];
        let solved = self.frames(solved, 0.0).rotation[self.wrist];
        let relative = |row: usize, column: usize| -> f64 { (0..3).map(|k| solved[k][row] * wanted[k][column]).sum() };
        let angle = (relative(0, 2) - relative(2, 0)).atan2(relative(0, 0) + relative(2, 2));
        let [low, high] = JOINT_RANGES[self.roll];
        wrap(angle, self.roll).clamp(low, high)
    }
}

/// A least-squares problem within the ranges. The residuals are the positions of elbow and wrist, and the angles.
struct Problem<'a> {
    arm: &'a Arm,
    wanted: Six,
    targets: [Vector; 2],
    /// The square of the regularisation.
    weight: f64,
}

/// The objective (half a sum of squares) and its derivatives at a point.
struct Local {
    value: f64,
    gradient: Six,
    /// Jᵀ J plus the regularisation.
    gauss_newton: Square,
    /// The Gauss-Newton matrix plus the second derivatives of the residuals.
    hessian: Square,
}

impl<'a> Problem<'a> {
    fn new(arm: &'a Arm, wanted: Six, regularisation: f64) -> Self {
        let frames = arm.frames(&wanted, 0.0);
        let targets = [frames.position[arm.elbow], frames.position[arm.wrist]];
        Self { arm, wanted, targets, weight: regularisation * regularisation }
    }

    fn range(&self, index: usize) -> [f64; 2] {
        JOINT_RANGES[self.arm.joints[index]]
    }

    /// The minimum that Newton's method reaches from the clamped angles.
    fn solve(&self) -> Six {
        let clamp =
            |angles: Six| -> Six { std::array::from_fn(|i| angles[i].clamp(self.range(i)[0], self.range(i)[1])) };
        let mut angles = clamp(self.wanted);
        let mut local = self.local(&angles);
        for _ in 0..NEWTON_STEPS {
            let matrix =
                if has_eigenvalues_above(CONVEX, &local.hessian) { &local.hessian } else { &local.gauss_newton };
            let step = self.box_step(&angles, &local.gradient, matrix);
            let size = step.iter().fold(0.0, |size: f64, part| size.max(part.abs()));
            let mut fraction = 1.0;
            let (next, reached) = loop {
                let next: Six = std::array::from_fn(|i| angles[i] + fraction * step[i]);
                let reached = self.local(&next);
                if reached.value <= local.value || size < NEAR || fraction < NEAR {
                    break (next, reached);
                }
                fraction /= 2.0;
            };
            (angles, local) = (next, reached);
            if fraction * size < CONVERGED {
                break;
            }
        }
        clamp(angles)
    }

    fn local(&self, angles: &Six) -> Local {
        let frames = self.arm.frames(angles, 0.0);
        let away: Six = std::array::from_fn(|i| angles[i] - self.wanted[i]);
        let mut gauss_newton = [[0.0; 6]; 6];
        for (i, row) in gauss_newton.iter_mut().enumerate() {
            row[i] = self.weight;
        }
        let mut local = Local {
            value: 0.5 * self.weight * dot(&away, &away),
            gradient: away.map(|part| self.weight * part),
            gauss_newton,
            hessian: gauss_newton,
        };
        // The elbow's hinge does not move the elbow.
        for (body, target, hinges) in [(self.arm.elbow, self.targets[0], 5), (self.arm.wrist, self.targets[1], 6)] {
            self.add_point(&mut local, &frames, frames.position[body], target, hinges);
        }
        local
    }

    /// Adds the residual of one point. The first `hinges` angles move the point.
    fn add_point(&self, local: &mut Local, frames: &Frames, point: Vector, target: Vector, hinges: usize) {
        let residual = subtract(point, target);
        let axis = |i: usize| frames.axis[self.arm.joints[i]];
        let columns: [Vector; 6] = std::array::from_fn(|i| {
            if i < hinges { cross(axis(i), subtract(point, frames.position[self.arm.turns[i]])) } else { [0.0; 3] }
        });
        local.value += 0.5 * dot(&residual, &residual);
        for i in 0..hinges {
            local.gradient[i] += dot(&columns[i], &residual);
            for j in 0..hinges {
                let squares = dot(&columns[i], &columns[j]);
                let (inner, outer) = (i.min(j), i.max(j));
                let curvature = dot(&residual, &cross(axis(inner), columns[outer]));
                local.gauss_newton[i][j] += squares;
                local.hessian[i][j] += squares + curvature;
            }
        }
    }

    /// The step to the minimum of the quadratic model within the ranges, by Gauss-Seidel with clipping.
    fn box_step(&self, angles: &Six, gradient: &Six, matrix: &Square) -> Six {
        let mut step = [0.0; 6];
        for _ in 0..BOX_STEPS {
            let mut change: f64 = 0.0;
            for i in 0..6 {
                let [low, high] = self.range(i);
                let free = step[i] - (dot(&matrix[i], &step) + gradient[i]) / matrix[i][i];
                let next = free.max(low - angles[i]).min(high - angles[i]);
                change = change.max((next - step[i]).abs());
                step[i] = next;
            }
            if change < 1e-15 {
                break;
            }
        }
        step
    }
}

/// Whether every eigenvalue of a symmetric matrix is above `least`: the matrix minus `least`·I then has a Cholesky
/// factor.
fn has_eigenvalues_above(least: f64, matrix: &Square) -> bool {
    let mut factor = [[0.0; 6]; 6];
    for row in 0..6 {
        for column in 0..=row {
            let shift = if row == column { least } else { 0.0 };
            let known: f64 = (0..column).map(|k| factor[row][k] * factor[column][k]).sum();
            let rest = matrix[row][column] - shift - known;
            if row != column {
                factor[row][column] = rest / factor[column][column];
            } else if rest > 0.0 {
                factor[row][row] = rest.sqrt();
            } else {
                return false;
            }
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_arm_within_its_ranges_is_not_changed() {
        let free = [0.0; 56];
        let mut joints = [0.1; 56];
        fit(&free, &mut joints, REGULARISATION);
        assert_eq!(joints, [0.1; 56]);
    }

    #[test]
    fn fitting_a_hanging_right_arm_is_better_than_clamping() {
        let [_, arm] = &ARMS;
        let wanted = [0.0, 0.0, -1.45, 0.1, 0.2, 0.3];
        let problem = Problem::new(arm, wanted, REGULARISATION);
        let clamped = std::array::from_fn(|i| wanted[i].clamp(problem.range(i)[0], problem.range(i)[1]));
        let solved = problem.solve();
        assert!(problem.local(&solved).value < 0.7 * problem.local(&clamped).value);
        assert!(solved.iter().zip(arm.joints).all(|(angle, joint)| excess(*angle, joint) == 0.0));
    }

    #[test]
    fn derivatives_equal_finite_differences_of_the_value() {
        let [arm, _] = &ARMS;
        let problem = Problem::new(arm, [0.3, -0.2, 1.9, 0.4, -0.3, 0.6], 0.2);
        let at = [0.1, 0.05, 1.2, 0.3, 0.2, 0.9];
        let local = problem.local(&at);
        for i in 0..6 {
            let moved = |by: f64| problem.local(&std::array::from_fn(|j| at[j] + if i == j { by } else { 0.0 }));
            let (less, more) = (moved(-1e-5), moved(1e-5));
            assert!((local.gradient[i] - (more.value - less.value) / 2e-5).abs() < 1e-8);
            for j in 0..6 {
                let slope = (more.gradient[j] - less.gradient[j]) / 2e-5;
                assert!((local.hessian[i][j] - slope).abs() < 1e-7, "{i}, {j}");
            }
        }
    }
}
