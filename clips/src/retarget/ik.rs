//! Inverse kinematics: the pose within the joints' ranges that is nearest to targets, by damped Gauss-Newton steps.

use super::geometry::column;
use super::linear::{Square, UNKNOWNS, solve};
use crate::body::{BODIES, Frames, ROOT, hinges, parent};
use crate::humanoid::JOINT_RANGES;
use crate::spatial::{
    Matrix, Quaternion, Vector, about_vector, cross, dot, multiply, norm, normalize, rotate, scale, subtract,
};

/// The first joint among the unknowns.
const FIRST: usize = 6;
/// Greatest number of steps for a pose.
const STEPS: usize = 40;
/// The search ends with a step smaller than this, rad and m.
const CONVERGED: f64 = 1e-6;
/// The search ends when a step lowers the objective by a smaller share.
const GAIN: f64 = 1e-9;
/// Passes that fix unknowns which a step would move out of their ranges.
const PASSES: usize = 10;

/// A pose of the body.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Pose {
    /// Root, m, world frame.
    pub(super) position: Vector,
    /// Root.
    pub(super) quaternion: Quaternion,
    /// rad.
    pub(super) joints: [f64; 56],
}

impl Pose {
    pub(super) fn frames(&self) -> Frames {
        Frames::of(&self.position, &self.quaternion, &self.joints)
    }
}

/// The orientation that a body should have.
#[derive(Clone, Debug)]
pub(super) struct Turn {
    pub(super) body: usize,
    /// World frame.
    pub(super) rotation: Matrix,
    /// Weights of the directions of the body's x, y and z axes.
    pub(super) weights: Vector,
}

/// The place that the origin of a body should have, m.
#[derive(Clone, Debug)]
pub(super) struct Reach {
    pub(super) body: usize,
    /// The place is relative to this body's origin, or else to the world's; always in the world's axes.
    pub(super) from: Option<usize>,
    pub(super) place: Vector,
    /// 1/m².
    pub(super) weight: f64,
}

/// What a pose should be like.
#[derive(Clone, Debug)]
pub(super) struct Goal {
    pub(super) turns: Vec<Turn>,
    pub(super) reaches: Vec<Reach>,
    /// Joints that a pose is drawn to, rad, with a weight.
    pub(super) near: ([f64; 56], f64),
}

/// Half the sum of squares, its gradient, and the Gauss-Newton matrix.
struct Local {
    value: f64,
    gradient: [f64; UNKNOWNS],
    matrix: Square,
}

/// The body with the ranges of its joints.
pub(super) struct Solver {
    low: [f64; UNKNOWNS],
    high: [f64; UNKNOWNS],
    /// The joints' angles without targets, rad.
    neutral: [f64; 56],
    /// Weight of the distance to them.
    stiffness: f64,
    /// For each body, the unknowns that turn it.
    chains: Vec<Vec<usize>>,
    /// For each unknown, the body at whose origin it turns.
    carriers: [usize; UNKNOWNS],
}

impl Solver {
    /// Joints in `fixed` keep their angle (rad). The other joints are drawn to 0, as far as it is in their range.
    pub(super) fn new(fixed: &[(usize, f64)], stiffness: f64) -> Self {
        let mut low = [f64::NEG_INFINITY; UNKNOWNS];
        let mut high = [f64::INFINITY; UNKNOWNS];
        for (joint, [least, greatest]) in JOINT_RANGES.into_iter().enumerate() {
            let angle = fixed.iter().find(|(fixed, _)| *fixed == joint).map(|(_, angle)| *angle);
            low[FIRST + joint] = angle.unwrap_or(least);
            high[FIRST + joint] = angle.unwrap_or(greatest);
        }
        let neutral = std::array::from_fn(|joint| 0f64.clamp(low[FIRST + joint], high[FIRST + joint]));
        let mut chains: Vec<Vec<usize>> = vec![Vec::new(), (3..FIRST).collect()];
        for body in ROOT + 1..BODIES {
            let mut chain = chains[parent(body)].clone();
            chain.extend(hinges(body).map(|joint| FIRST + joint));
            chains.push(chain);
        }
        let mut carriers = [ROOT; UNKNOWNS];
        for body in ROOT + 1..BODIES {
            hinges(body).for_each(|joint| carriers[FIRST + joint] = body);
        }
        Self { low, high, neutral, stiffness, chains, carriers }
    }

    /// The pose without targets.
    pub(super) fn neutral(&self, position: Vector, quaternion: Quaternion) -> Pose {
        Pose { position, quaternion, joints: self.neutral }
    }

    /// The minimum that damped Gauss-Newton steps reach from `start`, and the objective there.
    pub(super) fn solve(&self, start: &Pose, goal: &Goal) -> (Pose, f64) {
        let mut pose = self.moved(start, &[0.0; UNKNOWNS]);
        let mut local = self.local(&pose, goal);
        let mut damping = 1e-6;
        for _ in 0..STEPS {
            let step = self.step(&pose, &local, damping);
            let next = self.moved(&pose, &step);
            let value = self.value(&next.frames(), &next, goal);
            // A value that is not a number fails, too.
            if value <= local.value {
                let size = step.iter().fold(0.0, |size: f64, part| size.max(part.abs()));
                let done = size < CONVERGED || local.value - value < GAIN * local.value;
                pose = next;
                if done {
                    return (pose, value);
                }
                local = self.local(&pose, goal);
                damping = (damping / 4.0).max(1e-9);
            } else if damping > 1e6 {
                break;
            } else {
                damping = (damping * 8.0).max(1e-4);
            }
        }
        (pose, local.value)
    }

    /// The pose after a step, within the ranges.
    fn moved(&self, pose: &Pose, step: &[f64; UNKNOWNS]) -> Pose {
        let [x, y, z, about_x, about_y, about_z, ..] = *step;
        let turn = [about_x, about_y, about_z];
        let angle = norm(&turn);
        let quaternion = match angle > 0.0 {
            true => normalize(multiply(about_vector(scale(1.0 / angle, turn), angle), pose.quaternion)),
            false => pose.quaternion,
        };
        let joints = std::array::from_fn(|joint| {
            let unknown = FIRST + joint;
            (pose.joints[joint] + step[unknown]).clamp(self.low[unknown], self.high[unknown])
        });
        let [px, py, pz] = pose.position;
        Pose { position: [px + x, py + y, pz + z], quaternion, joints }
    }

    /// Half the weighted sum of squared distances from the targets.
    fn value(&self, frames: &Frames, pose: &Pose, goal: &Goal) -> f64 {
        let mut sum = 0.0;
        for turn in &goal.turns {
            for (column, weight) in turn.weights.into_iter().enumerate() {
                let away: f64 = (0..3)
                    .map(|row| (frames.rotation[turn.body][row][column] - turn.rotation[row][column]).powi(2))
                    .sum();
                sum += weight * away;
            }
        }
        for reach in &goal.reaches {
            let away = reach.away(frames);
            sum += reach.weight * dot(&away, &away);
        }
        let (near, weight) = &goal.near;
        for ((angle, neutral), near) in pose.joints.iter().zip(&self.neutral).zip(near) {
            sum += self.stiffness * (angle - neutral).powi(2) + weight * (angle - near).powi(2);
        }
        0.5 * sum
    }

    fn local(&self, pose: &Pose, goal: &Goal) -> Local {
        let frames = pose.frames();
        let mut local = Local {
            value: self.value(&frames, pose, goal),
            gradient: [0.0; UNKNOWNS],
            matrix: vec![[0.0; UNKNOWNS]; UNKNOWNS],
        };
        let (near, weight) = &goal.near;
        for (joint, angle) in pose.joints.iter().enumerate() {
            let unknown = FIRST + joint;
            local.gradient[unknown] = self.stiffness * (angle - self.neutral[joint]) + weight * (angle - near[joint]);
            local.matrix[unknown][unknown] = self.stiffness + weight;
        }
        self.add_turns(&mut local, &frames, goal);
        for reach in &goal.reaches {
            self.add_reach(&mut local, &frames, reach);
        }
        // Only the lower triangle is filled so far.
        for row in 0..UNKNOWNS {
            for column in 0..row {
                local.matrix[column][row] = local.matrix[row][column];
            }
        }
        local
    }

    /// A turn by a small angle about the axis a moves a direction c of a body by a × c. So a body adds aᵀ M b to the
    /// entry of the axes a and b, with M = Σ w (I − c cᵀ), and −a · Σ w (c × c*) to the gradient. An axis turns all
    /// bodies that its body carries, so the sums run over them.
    fn add_turns(&self, local: &mut Local, frames: &Frames, goal: &Goal) {
        let mut sums = [([[0.0; 3]; 3], [0.0; 3]); BODIES];
        for turn in &goal.turns {
            let (matrix, pull) = &mut sums[turn.body];
            for (index, weight) in turn.weights.into_iter().enumerate() {
                let own = column(&frames.rotation[turn.body], index);
                let wanted = cross(own, column(&turn.rotation, index));
                for row in 0..3 {
                    pull[row] += weight * wanted[row];
                    matrix[row][row] += weight;
                    for other in 0..3 {
                        matrix[row][other] -= weight * own[row] * own[other];
                    }
                }
            }
        }
        for body in (ROOT..BODIES).rev() {
            let (matrix, pull) = sums[body];
            let own = if body == ROOT { 3..FIRST } else { FIRST + hinges(body).start..FIRST + hinges(body).end };
            for unknown in own {
                let axis = axis(frames, unknown);
                local.gradient[unknown] -= dot(&axis, &pull);
                let turned = rotate(&matrix, axis);
                for other in self.chains[body].iter().take_while(|other| **other <= unknown) {
                    local.matrix[unknown][*other] += dot(&turned, &self::axis(frames, *other));
                }
            }
            if body > ROOT {
                let (outer, outer_pull) = &mut sums[parent(body)];
                for row in 0..3 {
                    outer_pull[row] += pull[row];
                    for other in 0..3 {
                        outer[row][other] += matrix[row][other];
                    }
                }
            }
        }
    }

    fn add_reach(&self, local: &mut Local, frames: &Frames, reach: &Reach) {
        let away = reach.away(frames);
        let mut columns: Vec<(usize, Vector)> = Vec::with_capacity(40);
        if reach.from.is_none() {
            columns.extend((0..3).map(|unknown| (unknown, axis_of(unknown))));
        }
        let shared = reach.from.map_or(0, |from| self.chains[from].len());
        for (place, unknown) in self.chains[reach.body].iter().enumerate() {
            // Both bodies turn about the axes that turn `from`.
            let origin = match reach.from {
                Some(from) if place < shared => frames.position[from],
                _ => frames.position[self.carriers[*unknown]],
            };
            let lever = subtract(frames.position[reach.body], origin);
            columns.push((*unknown, cross(axis(frames, *unknown), lever)));
        }
        for (place, (unknown, column)) in columns.iter().enumerate() {
            local.gradient[*unknown] += reach.weight * dot(column, &away);
            for (other, other_column) in &columns[..=place] {
                local.matrix[*unknown][*other] += reach.weight * dot(column, other_column);
            }
        }
    }

    /// The step to the minimum of the damped quadratic model within the ranges. Unknowns that it would move out of
    /// their ranges stop there, and the others are solved again.
    fn step(&self, pose: &Pose, local: &Local, damping: f64) -> [f64; UNKNOWNS] {
        let bounds = |unknown: usize| match unknown.checked_sub(FIRST) {
            Some(joint) => (self.low[unknown] - pose.joints[joint], self.high[unknown] - pose.joints[joint]),
            None => (f64::NEG_INFINITY, f64::INFINITY),
        };
        let mut step = [0.0; UNKNOWNS];
        let mut free: Vec<usize> = (0..UNKNOWNS)
            .filter(|unknown| {
                let (low, high) = bounds(*unknown);
                let outwards = local.gradient[*unknown];
                low < high && !(low >= 0.0 && outwards > 0.0) && !(high <= 0.0 && outwards < 0.0)
            })
            .collect();
        for _ in 0..PASSES {
            free.iter().for_each(|unknown| step[*unknown] = 0.0);
            let wanted =
                free.iter().map(|unknown| -local.gradient[*unknown] - dot(&local.matrix[*unknown], &step)).collect();
            let solved = solve(&local.matrix, &free, damping, wanted);
            let mut kept = Vec::with_capacity(free.len());
            for (unknown, part) in free.iter().zip(solved) {
                let (low, high) = bounds(*unknown);
                step[*unknown] = part.clamp(low.min(0.0), high.max(0.0));
                if step[*unknown] == part {
                    kept.push(*unknown);
                }
            }
            if kept.len() == free.len() {
                break;
            }
            free = kept;
        }
        step
    }
}

impl Reach {
    fn away(&self, frames: &Frames) -> Vector {
        let origin = self.from.map(|from| frames.position[from]).unwrap_or_default();
        subtract(subtract(frames.position[self.body], origin), self.place)
    }
}

/// A coordinate axis of the world.
fn axis_of(index: usize) -> Vector {
    std::array::from_fn(|part| f64::from(u8::from(part == index)))
}

/// The axis that an unknown turns about, world frame.
fn axis(frames: &Frames, unknown: usize) -> Vector {
    match unknown.checked_sub(FIRST) {
        Some(joint) => frames.axis[joint],
        None => axis_of(unknown - 3),
    }
}

#[cfg(test)]
mod tests;
