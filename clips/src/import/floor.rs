//! Finds the floor of a recording and puts the feet on it.

use comic_experiment::statistics::percentile;

use super::constants::Floor;
use super::sole;
use crate::body::{Frames, Geom, body, geoms, joint};
use crate::humanoid::JOINT_RANGES;
use crate::spatial::{Quaternion, Vector};

/// Greatest depth of a sole in the floor, m.
const TOLERANCE: f64 = 0.002;
/// Bisections of an ankle's angle: the precision is one part in 10¹².
const BISECTIONS: usize = 40;
/// Steps to either side over which the lift takes the deepest point and is smoothed.
const LIFT: usize = 3;
/// Greatest drift of CMU's floors in one take, m. A baseline that varies more follows jumps of the body.
const DRIFT: f64 = 0.08;

/// The poses of a clip during its import, one per step: root position (m) and orientation, joint angles (rad).
pub(crate) struct Poses {
    pub(crate) position: Vec<Vector>,
    pub(crate) quaternion: Vec<Quaternion>,
    pub(crate) joints: Vec<[f64; 56]>,
}

/// The ankle's index in [`JOINTS`](crate::JOINTS), and the indices of the two bodies of a foot.
struct Foot {
    ankle: usize,
    body: usize,
    toes: usize,
}

const FEET: [Foot; 2] = [
    Foot { ankle: joint("lfootrx"), body: body("lfoot"), toes: body("ltoes") },
    Foot { ankle: joint("rfootrx"), body: body("rfoot"), toes: body("rtoes") },
];

impl Poses {
    fn frames(&self, step: usize) -> Frames {
        Frames::of(&self.position[step], &self.quaternion[step], &self.joints[step])
    }

    /// Height of the body's lowest point at each step, m.
    fn lowest(&self) -> Vec<f64> {
        (0..self.position.len()).map(|step| self.frames(step).lowest().0).collect()
    }

    /// Puts the poses on the floor. Subtracts the height of the recording's floor, turns the ankles of feet that are
    /// below the floor, and lifts the body where a foot is still below. Returns the floor; if none is given, it is
    /// found.
    pub(crate) fn set_on_floor(&mut self, floor: Option<Floor>) -> Floor {
        let heights = self.lowest();
        let floor = floor.unwrap_or_else(|| find(&heights));
        for (position, base) in self.position.iter_mut().zip(baseline(&heights, floor)) {
            position[2] -= base;
        }
        for step in 0..self.joints.len() {
            let turned = FEET.map(|foot| self.ankle(step, &foot));
            for (foot, angle) in FEET.iter().zip(turned) {
                self.joints[step][foot.ankle] = angle;
            }
        }
        let depths: Vec<f64> = self.lowest().into_iter().map(|height| (-TOLERANCE - height).max(0.0)).collect();
        let deepest = sliding(&depths, LIFT, |window| window.iter().copied().fold(0.0, f64::max));
        for (position, lift) in self.position.iter_mut().zip(sliding(&deepest, LIFT, mean)) {
            position[2] += lift;
        }
        floor
    }

    /// The angle of a foot's ankle with which the foot is not below the floor, rad. It is the recorded angle, or the
    /// angle nearest to it on the way to a level sole.
    fn ankle(&self, step: usize, foot: &Foot) -> f64 {
        let frames = self.frames(step);
        let recorded = self.joints[step][foot.ankle];
        if foot.height(&frames) >= -TOLERANCE {
            return recorded;
        }
        let [low, high] = JOINT_RANGES[foot.ankle];
        let level = (recorded + sole::pitch(&frames, foot.body)).clamp(low, high);
        let angle = |share: f64| recorded + share * (level - recorded);
        let sinks = |angle: f64| {
            let mut joints = self.joints[step];
            joints[foot.ankle] = angle;
            foot.height(&Frames::of(&self.position[step], &self.quaternion[step], &joints)) < -TOLERANCE
        };
        if sinks(level) {
            return level;
        }
        let (mut sunk, mut clear) = (0.0, 1.0);
        for _ in 0..BISECTIONS {
            let middle = (sunk + clear) / 2.0;
            if sinks(angle(middle)) { sunk = middle } else { clear = middle }
        }
        angle(clear)
    }
}

impl Foot {
    /// Height of the foot's lowest point, m.
    fn height(&self, frames: &Frames) -> f64 {
        let own = |geom: &&Geom| geom.body == self.body || geom.body == self.toes;
        geoms().iter().filter(own).map(|geom| frames.bottom(geom)).fold(f64::INFINITY, f64::min)
    }
}

/// Finds the floor of a recording. It is a drifting floor; if that would follow the body into the air, a level floor.
fn find(heights: &[f64]) -> Floor {
    let base = baseline(heights, Floor::DRIFTING);
    let lowest = base.iter().copied().fold(f64::INFINITY, f64::min);
    let highest = base.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if highest - lowest > DRIFT { Floor::LEVEL } else { Floor::DRIFTING }
}

/// Height of the floor at each step, m, from the `heights` of the body's lowest points.
fn baseline(heights: &[f64], floor: Floor) -> Vec<f64> {
    let height = |heights: &[f64], percent| percentile(heights.to_vec(), percent).unwrap_or_default();
    match floor {
        Floor::Sliding { percent, half, smooth } => {
            sliding(&sliding(heights, half, |window| height(window, percent)), smooth, mean)
        }
        Floor::Constant { percent } => vec![height(heights, percent); heights.len()],
    }
}

/// Applies `of` to the window of each step: `half` steps to either side, shorter at the ends.
fn sliding(values: &[f64], half: usize, of: impl Fn(&[f64]) -> f64) -> Vec<f64> {
    (0..values.len())
        .map(|step| of(&values[step.saturating_sub(half)..step.saturating_add(half + 1).min(values.len())]))
        .collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_floor_follows_a_drift_and_not_a_jump() {
        let drift: Vec<f64> = (0..100).map(|step| 0.0005 * f64::from(step)).collect();
        assert_eq!(find(&drift), Floor::DRIFTING);
        let long_flight: Vec<f64> = (0..100).map(|step| if (40..70).contains(&step) { 0.5 } else { 0.0 }).collect();
        assert_eq!(find(&long_flight), Floor::LEVEL);
        assert!(baseline(&long_flight, Floor::LEVEL).iter().all(|height| *height == 0.0));
    }

    #[test]
    fn feet_below_the_floor_are_levelled_and_the_body_is_lifted() {
        let upright = [0.5; 4];
        let mut poses =
            Poses { position: vec![[0.0, 0.0, 1.0]; 9], quaternion: vec![upright; 9], joints: vec![[0.0; 56]; 9] };
        poses.set_on_floor(Some(Floor::Constant { percent: 50.0 }));
        let lowest = poses.lowest();
        assert!(lowest.iter().all(|height| (-0.002 - 1e-9..0.01).contains(height)), "{lowest:?}");
    }
}
