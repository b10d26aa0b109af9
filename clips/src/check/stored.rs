//! The checks of the datasets of one clip.

use super::defect::{
    Defect, IMPOSSIBLE, JOINT_EXCESS, JOINT_SPEED, Kind, MOST_JUMPS, ROOT_SPEED, ROOT_TURN, unreadable,
};
use super::pose::Pose;
use super::tally::Tally;
use crate::file::{NORM_TOLERANCE, Stored};
use crate::humanoid::{JOINT_RANGES, JOINTS};
use crate::spatial::{norm, normalize, rotation_between, subtract};

/// The pose in each frame. An entry is `None` if the dataset is unreadable or a number of the frame is not finite.
pub(super) struct Columns {
    position: Vec<Option<[f64; 3]>>,
    quaternion: Vec<Option<[f64; 4]>>,
    joints: Vec<Option<[f64; 56]>>,
}

impl Columns {
    /// Extracts the pose from the datasets, and the defects of each dataset on its own.
    pub(super) fn search(datasets: Vec<Stored>, steps: usize) -> (Self, Vec<Defect>) {
        let mut columns =
            Self { position: vec![None; steps], quaternion: vec![None; steps], joints: vec![None; steps] };
        let mut defects = Vec::new();
        for Stored { field, width, rows } in datasets {
            let rows = match rows {
                Ok(rows) => rows,
                Err(error) => {
                    defects.push(unreadable(field, &error));
                    continue;
                }
            };
            defects.extend(not_finite(field, &rows, width, steps));
            if field.ends_with("quaternion") || field.ends_with("quaternions") {
                defects.extend(norms(field, &rows, width, steps));
            }
            match field {
                "position" => columns.position = frames(&rows, steps),
                "quaternion" => columns.quaternion = frames(&rows, steps),
                "joints" => columns.joints = frames(&rows, steps),
                _ => {}
            }
        }
        (columns, defects)
    }

    /// Adds the joints that leave their range.
    pub(super) fn joint_limits(&self, defects: &mut Vec<Defect>) {
        for (joint, (name, [low, high])) in JOINTS.iter().zip(JOINT_RANGES).enumerate() {
            let mut tally = Tally::default();
            for (frame, joints) in self.joints.iter().enumerate() {
                let excess = joints.map_or(0.0, |joints| (low - joints[joint]).max(joints[joint] - high));
                if excess > JOINT_EXCESS {
                    tally.add(frame, excess);
                }
            }
            defects.extend(
                tally.defect(Kind::JointLimit, name, |worst| format!("{worst:.3} rad outside [{low}, {high}]")),
            );
        }
    }

    /// The body in each frame.
    pub(super) fn poses(&self) -> Vec<Option<Pose>> {
        let frames = self.position.iter().zip(&self.quaternion).zip(&self.joints);
        let pose = |((position, quaternion), joints): ((&Option<_>, &Option<_>), &Option<_>)| {
            Some(Pose::of(position.as_ref()?, quaternion.as_ref()?, joints.as_ref()?))
        };
        frames.map(pose).collect()
    }

    /// Adds the jumps of root and joints. `dt` is the time step, s.
    pub(super) fn jumps(&self, dt: f64, defects: &mut Vec<Defect>) {
        let speed = |a: [f64; 3], b: [f64; 3]| norm(&subtract(b, a)) / dt;
        let turn = |a, b| norm(&rotation_between(normalize(a), normalize(b))) / dt;
        let moved = |worst: f64| format!("{worst:.1} m/s from one frame to the next");
        let turned = |worst: f64| format!("{worst:.1} rad/s from one frame to the next");
        let impossible = |text: String| format!("{IMPOSSIBLE}: {text}");
        let root = faster(&self.position, ROOT_SPEED, speed);
        defects.extend(root.defect(Kind::Jump, "root", |worst| impossible(moved(worst))));
        let root = faster(&self.quaternion, ROOT_TURN, turn);
        defects.extend(root.defect(Kind::Jump, "root", |worst| impossible(turned(worst))));
        for (joint, name) in JOINTS.iter().enumerate() {
            let speed = |a: [f64; 56], b: [f64; 56]| (b[joint] - a[joint]).abs() / dt;
            let tally = faster(&self.joints, JOINT_SPEED, speed);
            let many = tally.frames() > MOST_JUMPS;
            defects.extend(
                tally.defect(Kind::Jump, name, |worst| if many { impossible(turned(worst)) } else { turned(worst) }),
            );
        }
    }
}

/// The frames whose change from the previous frame is faster than `limit`.
fn faster<const N: usize>(frames: &[Option<[f64; N]>], limit: f64, speed: impl Fn([f64; N], [f64; N]) -> f64) -> Tally {
    let mut tally = Tally::default();
    for (frame, pair) in frames.windows(2).enumerate() {
        if let [Some(before), Some(after)] = pair {
            let speed = speed(*before, *after);
            if speed > limit {
                tally.add(frame + 1, speed);
            }
        }
    }
    tally
}

fn not_finite(field: &str, rows: &[f64], width: usize, steps: usize) -> Option<Defect> {
    let mut tally = Tally::default();
    let mut numbers = 0;
    for frame in 0..steps {
        let bad = (0..width).filter(|row| !rows[row * steps + frame].is_finite()).count();
        if bad > 0 {
            numbers += bad;
            tally.add(frame, numbers as f64);
        }
    }
    tally.defect(Kind::NotFinite, field, |worst| format!("{worst} numbers are NaN or infinite"))
}

fn norms(field: &str, rows: &[f64], width: usize, steps: usize) -> Option<Defect> {
    let mut tally = Tally::default();
    for frame in 0..steps {
        let off = |first: usize| {
            let parts: [f64; 4] = std::array::from_fn(|part| rows[(first + part) * steps + frame]);
            (norm(&parts) - 1.0).abs()
        };
        // NaN is a defect of another kind; `max` ignores it.
        let worst = (0..width).step_by(4).map(off).fold(0.0, f64::max);
        if worst >= NORM_TOLERANCE {
            tally.add(frame, worst);
        }
    }
    tally.defect(Kind::QuaternionNorm, field, |worst| format!("norm off by {worst:.3}; it must be 1"))
}

/// Turns rows `(N, T)` into frames.
fn frames<const N: usize>(rows: &[f64], steps: usize) -> Vec<Option<[f64; N]>> {
    (0..steps)
        .map(|frame| {
            let column: [f64; N] = std::array::from_fn(|row| rows[row * steps + frame]);
            column.iter().all(|number| number.is_finite()).then_some(column)
        })
        .collect()
}
