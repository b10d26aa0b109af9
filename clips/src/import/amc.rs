//! AMC files: the angles of a skeleton, frame by frame.

use std::path::Path;

use super::lines::Lines;
use super::skeleton::{BONES, Bone};
use crate::error::Error;

/// Greatest number of recorded frames: they give 100,000 frames of 0.03 s, the longest clip that can be read.
const FRAMES: usize = 360_000;

/// The bit of the root. Bits 0 to 55 are the joints.
const ROOT: u64 = 1 << 63;

/// The content of an AMC file.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Recording {
    /// For each frame: position in the file's units, then angles about x, y, z in degrees.
    pub(super) root: Vec<[f64; 6]>,
    /// For each frame: angles in degrees, in the order of [`JOINTS`](crate::JOINTS); 0 for joints that the file does
    /// not have.
    pub(super) angles: Vec<[f64; 56]>,
    /// The first frame whose number is not the previous number plus one.
    pub(super) gap: Option<u64>,
    /// The joints of the first frame, one bit each. Every other frame must have the same joints.
    present: Option<u64>,
}

impl Recording {
    pub(super) fn read(path: &Path) -> Result<Self, Error> {
        let mut lines = Lines::open(path)?;
        let mut recording = Self::default();
        // `None` before the first frame.
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
            return Err(lines.error(format!("more than {FRAMES} frames: shorten the recording")));
        }
        self.root.push([0.0; 6]);
        self.angles.push([0.0; 56]);
        Ok(())
    }

    /// Checks that the previous frame is complete. A truncated file does not have the last bones.
    fn complete(&mut self, lines: &Lines, seen: Option<u64>) -> Result<(), Error> {
        let Some(seen) = seen else { return Ok(()) };
        let frame = self.root.len();
        if seen & ROOT == 0 {
            return Err(lines.error(format!("frame {frame} has no `root`")));
        }
        let present = *self.present.get_or_insert(seen);
        if seen == present {
            return Ok(());
        }
        let differ = |bone: &&Bone| bone.joints().any(|joint| (seen ^ present) & (1 << joint) != 0);
        let bones: Vec<&str> = BONES.iter().filter(differ).map(|bone| bone.name).collect();
        let reason = "has other bones than the first frame (they differ in";
        Err(lines.error(format!("frame {frame} {reason} {}): is the file complete?", bones.join(", "))))
    }

    /// Reads the line of a bone into the last frame. Returns the bits of its joints, or the bit of the root.
    fn take(&mut self, lines: &Lines, name: &str, words: &[String]) -> Result<u64, Error> {
        let (Some(root), Some(angles)) = (self.root.last_mut(), self.angles.last_mut()) else {
            return Err(lines.error("expected the number of a frame: is this an AMC file?"));
        };
        let count = |wanted: usize| {
            if words.len() == wanted {
                return Ok(());
            }
            Err(lines.error(format!("{name} has {} numbers, expected {wanted}", words.len())))
        };
        if name == "root" {
            count(root.len())?;
            for (entry, word) in root.iter_mut().zip(words) {
                *entry = lines.number(word)?;
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
