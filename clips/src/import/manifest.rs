//! Manifests: a JSON list of takes with the constants of each.

use std::io::Read as _;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::constants::{Constants, Floor, Take};
use crate::error::Error;

/// Greatest length of a manifest, bytes.
const LONGEST: u64 = 16 << 20;

/// One take. Other fields of the object, like a description, are ignored.
#[derive(Deserialize)]
struct Listed {
    key: String,
    asf: PathBuf,
    amc: PathBuf,
    frames: Option<[usize; 2]>,
    sole_deg: Option<[f64; 2]>,
    floor: Option<ListedFloor>,
    arm_reg: Option<f64>,
    scale: Option<f64>,
}

#[derive(Deserialize)]
#[serde(tag = "mode")]
enum ListedFloor {
    #[serde(rename = "sliding")]
    Sliding { pct: f64, half: usize, smooth: usize },
    #[serde(rename = "const")]
    Constant { pct: f64 },
}

/// Reads a manifest: an array of objects with `key` (the clip's name), `asf` and `amc` (files beside the manifest), and
/// optionally `frames` `[first, end]`, `sole_deg` `[left, right]`, `floor` (`{"mode": "sliding", "pct", "half",
/// "smooth"}` or `{"mode": "const", "pct"}`), `arm_reg` and `scale`.
///
/// # Errors
/// [`Error::Unreadable`]; [`Error::Recording`] if the file is not such a list.
pub fn read_manifest(path: &Path) -> Result<Vec<Take>, Error> {
    let unreadable = |reason| Error::Unreadable { path: path.into(), reason };
    let wrong = |reason: String| Error::Recording { path: path.into(), reason };
    let mut text = String::new();
    // A device has no length in its metadata, so the limit applies to the bytes that are read.
    let file = std::fs::File::open(path).map_err(unreadable)?;
    let length = file.take(LONGEST + 1).read_to_string(&mut text).map_err(unreadable)?;
    if length as u64 > LONGEST {
        return Err(wrong("too long for a manifest".into()));
    }
    // The message of serde has line and column.
    let listed: Vec<Listed> = serde_json::from_str(&text).map_err(|error| wrong(format!("not a manifest: {error}")))?;
    let directory = path.parent().unwrap_or(Path::new(""));
    Ok(listed.into_iter().map(|take| take.within(directory)).collect())
}

impl Listed {
    /// The take, with paths relative to `directory`.
    fn within(self, directory: &Path) -> Take {
        let constants = Constants {
            scale: self.scale,
            sole_degrees: self.sole_deg,
            floor: self.floor.map(|floor| match floor {
                ListedFloor::Sliding { pct, half, smooth } => Floor::Sliding { percent: pct, half, smooth },
                ListedFloor::Constant { pct } => Floor::Constant { percent: pct },
            }),
            arm_regularisation: self.arm_reg,
            frames: self.frames.map(|[first, end]| first..end),
        };
        Take { name: self.key, asf: directory.join(self.asf), amc: directory.join(self.amc), constants }
    }
}
