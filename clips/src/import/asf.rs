//! ASF files: the skeleton of a subject.

use std::path::Path;

use super::lines::Lines;
use super::skeleton::Bone;
use crate::body::{self, Frames};
use crate::error::Error;
use crate::spatial::{about, matrix, multiply};

/// One inch, m. The unit of length in a file is one inch divided by the `length` under `:units`.
const INCH: f64 = 0.0254;
/// Length of thigh plus shank of the V2020 body, m: 1.2 times the numbers of `humanoid_CMU_V2020.xml`.
const LEG: f64 = 1.2 * (0.404945 + 0.415693);
/// Greatest difference between an element of a bone's rotation matrix and the body's. Files round to six digits.
const SAME_AXIS: f64 = 1e-3;
/// The bones whose lengths determine the scale.
const LEG_BONES: [&str; 4] = ["lfemur", "ltibia", "rfemur", "rtibia"];

/// The data of a skeleton that the import needs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Skeleton {
    /// One unit of length in the file, m.
    pub(super) meters: f64,
    /// Factor by which lengths of the motion grow: the body's leg divided by the subject's leg.
    pub(super) scale: f64,
}

/// A bone whose lines are being read.
#[derive(Default)]
struct Reading {
    name: String,
    length: f64,
    axis: Option<[f64; 3]>,
    dofs: Vec<String>,
}

impl Skeleton {
    /// Reads a file, and checks that its bones have the same axes as the body.
    pub(super) fn read(path: &Path) -> Result<Self, Error> {
        let mut lines = Lines::open(path)?;
        let (mut section, mut unit) = (String::new(), None);
        let (mut bone, mut legs) = (None, [None; 4]);
        while let Some(words) = lines.next_words()? {
            let word = words[0].as_str();
            let rest = &words[1..];
            match (section.as_str(), word) {
                (_, keyword) if keyword.starts_with(':') => section = keyword.into(),
                (":units", "length") => unit = Some(positive(&lines, rest)?),
                (":units", "angle") if rest != ["deg"] => {
                    return Err(lines.error("angles must be in degrees: `angle deg`"));
                }
                (":root", "order") => expect(&lines, rest, "TX TY TZ RX RY RZ")?,
                (":root", "orientation") => expect_zero(&lines, rest)?,
                (":bonedata", "begin") => bone = Some(Reading::default()),
                (":bonedata", "end") => {
                    let bone: Reading = bone.take().ok_or_else(|| lines.error("`end` without `begin`"))?;
                    bone.check(&lines)?;
                    if let Some(place) = LEG_BONES.iter().position(|name| *name == bone.name) {
                        legs[place] = Some(bone.length);
                    }
                }
                (":bonedata", _) => {
                    if let Some(bone) = &mut bone {
                        bone.line(&lines, word, rest)?;
                    }
                }
                _ => {}
            }
        }
        let whole = |reason: String| Error::Recording { path: path.into(), reason };
        let unit = unit.ok_or_else(|| whole("no `length` under `:units`: is this an ASF file?".into()))?;
        let mut leg = 0.0;
        for (name, length) in LEG_BONES.iter().zip(legs) {
            leg += length.ok_or_else(|| whole(format!("no bone {name} under `:bonedata`")))?;
        }
        let meters = INCH / unit;
        if leg <= 0.0 {
            return Err(whole("the legs have length 0".into()));
        }
        Ok(Self { meters, scale: LEG / (meters * leg / 2.0) })
    }
}

impl Reading {
    fn line(&mut self, lines: &Lines, word: &str, rest: &[String]) -> Result<(), Error> {
        match (word, rest) {
            ("name", [name]) => self.name.clone_from(name),
            ("length", [length]) => self.length = lines.number(length)?,
            ("dof", dofs) => self.dofs = dofs.to_vec(),
            ("axis", [x, y, z, order]) => {
                if order != "XYZ" {
                    return Err(lines.error(format!("axis order {order}: expected XYZ")));
                }
                self.axis = Some([lines.number(x)?, lines.number(y)?, lines.number(z)?]);
            }
            // The import does not need the direction, the limits and other entries.
            _ => {}
        }
        Ok(())
    }

    /// Checks that this bone is one of CMU's, or does not move.
    fn check(&self, lines: &Lines) -> Result<(), Error> {
        let name = &self.name;
        let refuse = |what: String| {
            Err(lines.error(format!("bone {name}: {what}; only skeletons of the CMU database can be imported")))
        };
        match Bone::find(name) {
            None if self.dofs.is_empty() => Ok(()),
            None => refuse(format!("moves ({}), but the body has no joint for it", self.dofs.join(" "))),
            Some(bone) if self.dofs != bone.dofs => {
                refuse(format!("has dof `{}`, expected `{}`", self.dofs.join(" "), bone.dofs.join(" ")))
            }
            Some(bone) => match self.axis {
                None => refuse("has no axis".into()),
                Some(axis) if !same_as_body(bone, axis) => {
                    refuse(format!("has axis {axis:?}, which differs from the body's"))
                }
                Some(_) => Ok(()),
            },
        }
    }
}

/// Whether the body's frame at zero angles has this orientation: degrees about x, y, z, x first.
fn same_as_body(bone: &Bone, axis: [f64; 3]) -> bool {
    let [x, y, z] = axis.map(f64::to_radians);
    let bones = matrix(multiply(about(2, z), multiply(about(1, y), about(0, x))));
    let bodys = Frames::zero().rotation[body::index(bone.name).unwrap_or_default()];
    bones.as_flattened().iter().zip(bodys.as_flattened()).all(|(a, b)| (a - b).abs() < SAME_AXIS)
}

fn positive(lines: &Lines, words: &[String]) -> Result<f64, Error> {
    match words {
        [word] => match lines.number(word)? {
            number if number > 1e-6 => Ok(number),
            number => Err(lines.error(format!("{number} is not a valid length"))),
        },
        _ => Err(lines.error("expected one number")),
    }
}

fn expect(lines: &Lines, words: &[String], wanted: &str) -> Result<(), Error> {
    let found = words.join(" ");
    if found.eq_ignore_ascii_case(wanted) {
        return Ok(());
    }
    Err(lines.error(format!("the root's order is `{found}`; expected `{wanted}`")))
}

fn expect_zero(lines: &Lines, words: &[String]) -> Result<(), Error> {
    for word in words {
        if lines.number(word)?.abs() > 1e-6 {
            return Err(lines.error("the root is rotated; only skeletons of the CMU database can be imported"));
        }
    }
    Ok(())
}
