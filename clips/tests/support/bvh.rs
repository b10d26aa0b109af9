//! Writes BVH files.

use std::io::{self, Write};

use comic_clips::retarget::{Recorded, RecordedBone};
use comic_clips::spatial::{Quaternion, matrix};

/// Cosine of the middle angle below which the outer two angles turn about the same axis.
const LOCKED: f64 = 1e-7;

/// What remains to be written, the last first.
enum Step {
    /// Opens the block of a bone, at a depth.
    Open(usize, usize),
    /// Closes a block, at a depth.
    Close(usize),
}

/// Writes `recorded` as a BVH file, in its own unit and axes. Angles are in degrees, in the order z, x, y. Numbers have
/// six decimals. The bones are depth first.
pub(crate) fn write_bvh(recorded: &Recorded, out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "HIERARCHY")?;
    let mut order = Vec::new();
    let mut steps = vec![Step::Open(0, 0)];
    while let Some(step) = steps.pop() {
        match step {
            Step::Close(depth) => writeln!(out, "{}}}", "\t".repeat(depth))?,
            Step::Open(index, depth) => {
                order.push(index);
                let children: Vec<usize> =
                    (0..recorded.bones.len()).filter(|bone| recorded.bones[*bone].parent == Some(index)).collect();
                open(&recorded.bones[index], depth, children.is_empty(), out)?;
                steps.push(Step::Close(depth));
                steps.extend(children.into_iter().rev().map(|child| Step::Open(child, depth + 1)));
            }
        }
    }
    writeln!(out, "MOTION\nFrames: {}\nFrame Time: {:.8}", recorded.frames.len(), recorded.frame_seconds)?;
    for pose in &recorded.frames {
        let [x, y, z] = pose.position;
        write!(out, "{x:.6} {y:.6} {z:.6}")?;
        for bone in &order {
            let [z, x, y] = zxy(pose.rotations[*bone]).map(f64::to_degrees);
            write!(out, " {z:.6} {x:.6} {y:.6}")?;
        }
        writeln!(out)?;
    }
    Ok(())
}

/// Writes a bone up to its channels, and its end site if it has no children.
fn open(bone: &RecordedBone, depth: usize, last: bool, out: &mut impl Write) -> io::Result<()> {
    let (indent, [x, y, z]) = ("\t".repeat(depth), bone.offset);
    let (keyword, channels) = match bone.parent {
        None => ("ROOT", "6 Xposition Yposition Zposition"),
        Some(_) => ("JOINT", "3"),
    };
    writeln!(out, "{indent}{keyword} {}\n{indent}{{\n{indent}\tOFFSET {x:.6} {y:.6} {z:.6}", bone.name)?;
    writeln!(out, "{indent}\tCHANNELS {channels} Zrotation Xrotation Yrotation")?;
    if last {
        let [x, y, z] = bone.end.unwrap_or_default();
        writeln!(out, "{indent}\tEnd Site\n{indent}\t{{\n{indent}\t\tOFFSET {x:.6} {y:.6} {z:.6}\n{indent}\t}}")?;
    }
    Ok(())
}

/// The angles z, x, y (rad) of a rotation: about z, then about the new x, then about the new y.
fn zxy(rotation: Quaternion) -> [f64; 3] {
    let [first, second, third] = matrix(rotation);
    let cosine = first[1].hypot(second[1]);
    let x = third[1].atan2(cosine);
    if cosine < LOCKED {
        return [second[0].atan2(first[0]), x, 0.0];
    }
    [(-first[1]).atan2(second[1]), x, (-third[0]).atan2(third[2])]
}
