//! AMC: a recording of a skeleton, its angles frame by frame.

use std::path::Path;

use super::lines::Lines;
use super::skeleton::{BONES, Bone};
use crate::error::Error;

/// Longest recording taken: 100,000 frames of 0.03 s, the longest clip that is read back.
const FRAMES: usize = 360_000;

/// The root's bit, beyond those of the 56 joints.
const ROOT: u64 = 1 << 63;

/// A recording, as its file has it.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Recording {
    /// Position in the file's units, then angles about x, y, z, degrees; per frame.
    pub(super) root: Vec<[f64; 6]>,
    /// Degrees, in the order of [`JOINTS`](crate::JOINTS); 0 where the file says nothing; per frame.
    pub(super) angles: Vec<[f64; 56]>,
    /// The first frame whose number is not one more than the last one's.
    pub(super) gap: Option<u64>,
    /// The joints that the first frame tells of, a bit each: every other frame tells of the same.
    told: Option<u64>,
}

impl Recording {
    pub(super) fn read(path: &Path) -> Result<Self, Error> {
        let mut lines = Lines::open(path)?;
        let mut recording = Self::default();
        // None before the first frame.
        let (mut number, mut seen) = (None, None);
        while let Some(words) = lines.next_words()? {
            let word = words[0].as_str();
            if word.eq_ignore_ascii_case(":radians") {
                return Err(lines.error("angles must be in degrees"));
            }
            if word.starts_with(':') {
                continue;
            }
            if let ([_], Ok(next)) = (words.as_slice(), word.parse::<u64>()) {
                recording.begin(&lines, seen)?;
                if number.is_some_and(|last: u64| last.checked_add(1) != Some(next)) {
                    recording.gap = recording.gap.or(Some(next));
                }
                (number, seen) = (Some(next), Some(0));
            } else {
                let bits = recording.take(&lines, word, &words[1..])?;
                seen = seen.map(|seen| seen | bits);
            }
        }
        if recording.root.is_empty() {
            return Err(Error::Recording { path: path.into(), reason: "no frames: is this an AMC file?".into() });
        }
        recording.complete(&lines, seen)?;
        Ok(recording)
    }

    fn begin(&mut self, lines: &Lines, seen: Option<u64>) -> Result<(), Error> {
        self.complete(lines, seen)?;
        if self.root.len() == FRAMES {
            return Err(lines.error(format!("over {FRAMES} frames: cut the recording")));
        }
        self.root.push([0.0; 6]);
        self.angles.push([0.0; 56]);
        Ok(())
    }

    /// Whether the frame before is whole: a file that was cut off lacks its last bones.
    fn complete(&mut self, lines: &Lines, seen: Option<u64>) -> Result<(), Error> {
        let Some(seen) = seen else { return Ok(()) };
        let frame = self.root.len();
        if seen & ROOT == 0 {
            return Err(lines.error(format!("frame {frame} has no `root`")));
        }
        let told = *self.told.get_or_insert(seen);
        if seen == told {
            return Ok(());
        }
        let differ = |bone: &&Bone| bone.joints().any(|joint| (seen ^ told) & (1 << joint) != 0);
        let bones: Vec<&str> = BONES.iter().filter(differ).map(|bone| bone.name).collect();
        let reason = "has other bones than the first (they differ in";
        Err(lines.error(format!("frame {frame} {reason} {}): is the file whole?", bones.join(", "))))
    }

    /// Takes a bone's line; a bit for each joint it tells of, or the root's.
    fn take(&mut self, lines: &Lines, name: &str, words: &[String]) -> Result<u64, Error> {
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
            return Ok(ROOT);
        }
        let Some(bone) = Bone::find(name) else {
            let known: Vec<&str> = BONES.iter().map(|bone| bone.name).collect();
            return Err(lines.error(format!("unknown bone `{name}`; CMU's skeletons have {}", known.join(", "))));
        };
        count(bone.dofs.len())?;
        for (joint, word) in bone.joints().zip(words) {
            angles[joint] = lines.number(word)?;
        }
        Ok(bone.joints().fold(0, |bits, joint| bits | 1 << joint))
    }
}
