//! The checks of the datasets of one clip.

use super::defect::{
    AIRBORNE, Defect, JOINT_EXCESS, JOINT_SPEED, Kind, LONGEST_FLIGHT, PENETRATION, ROOT_SPEED, ROOT_TURN, unreadable,
};
use super::tally::Tally;
use crate::body::Frames;
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

    /// Adds penetration and floating. Returns minimum and maximum of the height of the body's lowest point, m.
    pub(super) fn floor(&self, dt: f64, defects: &mut Vec<Defect>) -> Option<[f64; 2]> {
        let mut bounds: Option<[f64; 2]> = None;
        let (mut depth, mut deepest) = (Tally::default(), "");
        let (mut floating, mut flight) = (Tally::default(), Vec::new());
        let land = |flight: &mut Vec<(usize, f64)>, floating: &mut Tally| {
            if flight.len() as f64 * dt > LONGEST_FLIGHT {
                flight.iter().for_each(|(frame, height)| floating.add(*frame, *height));
            }
            flight.clear();
        };
        for frame in 0..self.position.len() {
            let (Some(position), Some(quaternion), Some(joints)) =
                (&self.position[frame], &self.quaternion[frame], &self.joints[frame])
            else {
                land(&mut flight, &mut floating);
                continue;
            };
            let (height, geom) = Frames::of(position, quaternion, joints).lowest();
            bounds = Some(bounds.map_or([height; 2], |[low, high]| [low.min(height), high.max(height)]));
            if height < -PENETRATION {
                if -height > depth.worst {
                    deepest = geom.name;
                }
                depth.add(frame, -height);
            }
            if height > AIRBORNE {
                flight.push((frame, height));
            } else {
                land(&mut flight, &mut floating);
            }
        }
        land(&mut flight, &mut floating);
        defects.extend(depth.defect(Kind::Penetration, deepest, |worst| format!("{worst:.3} m deep in the floor")));
        let detail = |worst| format!("up to {worst:.3} m above the floor for over {LONGEST_FLIGHT} s");
        defects.extend(floating.defect(Kind::Floating, "root", detail));
        bounds
    }

    /// Adds the jumps of root and joints. `dt` is the time step, s.
    pub(super) fn jumps(&self, dt: f64, defects: &mut Vec<Defect>) {
        let speed = |a: [f64; 3], b: [f64; 3]| norm(&subtract(b, a)) / dt;
        let turn = |a, b| norm(&rotation_between(normalize(a), normalize(b))) / dt;
        let moved = |worst: f64| format!("{worst:.1} m/s from one frame to the next");
        let turned = |worst: f64| format!("{worst:.1} rad/s from one frame to the next");
        defects.extend(faster(&self.position, ROOT_SPEED, speed).defect(Kind::Jump, "root", moved));
        defects.extend(faster(&self.quaternion, ROOT_TURN, turn).defect(Kind::Jump, "root", turned));
        for (joint, name) in JOINTS.iter().enumerate() {
            let speed = |a: [f64; 56], b: [f64; 56]| (b[joint] - a[joint]).abs() / dt;
            defects.extend(faster(&self.joints, JOINT_SPEED, speed).defect(Kind::Jump, name, turned));
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
