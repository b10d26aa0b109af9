//! AMC: a recording of a skeleton, its angles frame by frame.

use std::path::Path;

use super::lines::Lines;
use super::skeleton::{BONES, Bone};
use crate::Error;

/// Longest recording taken: 100,000 frames of 0.03 s, the longest clip that is read back.
const FRAMES: usize = 360_000;

/// A recording, as its file has it.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Recording {
    /// Position in the file's units, then angles about x, y, z, degrees; per frame.
    pub(super) root: Vec<[f64; 6]>,
    /// Degrees, in the order of [`JOINTS`](crate::JOINTS); 0 where the file says nothing; per frame.
    pub(super) angles: Vec<[f64; 56]>,
    /// The first frame whose number is not one more than the last one's.
    pub(super) gap: Option<u64>,
}

impl Recording {
    pub(super) fn read(path: &Path) -> Result<Self, Error> {
        let mut lines = Lines::open(path)?;
        let mut recording = Self::default();
        let (mut number, mut has_root) = (None, true);
        while let Some(words) = lines.next_words()? {
            let word = words[0].as_str();
            if word.eq_ignore_ascii_case(":radians") {
                return Err(lines.error("angles must be in degrees"));
            }
            if word.starts_with(':') {
                continue;
            }
            if let ([_], Ok(next)) = (words.as_slice(), word.parse::<u64>()) {
                recording.begin(&lines, has_root)?;
                if number.is_some_and(|last: u64| last.checked_add(1) != Some(next)) {
                    recording.gap = recording.gap.or(Some(next));
                }
                (number, has_root) = (Some(next), false);
            } else {
                has_root |= recording.take(&lines, word, &words[1..])?;
            }
        }
        if recording.root.is_empty() {
            return Err(Error::Recording { path: path.into(), reason: "no frames: is this an AMC file?".into() });
        }
        recording.complete(&lines, has_root)?;
        Ok(recording)
    }

    fn begin(&mut self, lines: &Lines, has_root: bool) -> Result<(), Error> {
        self.complete(lines, has_root)?;
        if self.root.len() == FRAMES {
            return Err(lines.error(format!("over {FRAMES} frames: cut the recording")));
        }
        self.root.push([0.0; 6]);
        self.angles.push([0.0; 56]);
        Ok(())
    }

    fn complete(&self, lines: &Lines, has_root: bool) -> Result<(), Error> {
        if has_root { Ok(()) } else { Err(lines.error(format!("frame {} has no `root`", self.root.len()))) }
    }

    /// Takes a bone's line; whether it was the root's.
    fn take(&mut self, lines: &Lines, name: &str, words: &[String]) -> Result<bool, Error> {
        let (Some(root), Some(angles)) = (self.root.last_mut(), self.angles.last_mut()) else {
            return Err(lines.error("expected a frame's number: is this an AMC file?"));
        };
        let count = |wanted: usize| {
            if words.len() == wanted {
                return Ok(());
            }
            Err(lines.error(format!("{name} has {} numbers, expected {wanted}", words.len())))
        };
        if name == "root" {
            count(root.len())?;
            for (place, word) in root.iter_mut().zip(words) {
                *place = lines.number(word)?;
            }
            return Ok(true);
        }
        let Some(bone) = Bone::find(name) else {
            let known: Vec<&str> = BONES.iter().map(|bone| bone.name).collect();
            return Err(lines.error(format!("unknown bone `{name}`; CMU's skeletons have {}", known.join(", "))));
        };
        count(bone.dofs.len())?;
        for (joint, word) in bone.joints().zip(words) {
            angles[joint] = lines.number(word)?;
        }
        Ok(false)
    }
}
