//! `comic-actor clips import --bvh` and `--smpl`: motions of other skeletons.

use std::path::Path;

use comic_clips::retarget::{Options, Recorded, Report, find_roles, read_bvh, read_roles, read_smpl, retarget};
use comic_clips::{Clip, ClipWriter};
use serde::Serialize;

use super::Import;
use crate::Error;
use crate::clips::{print, print_json};

/// What `--help` says about files of bones.
pub(super) const HELP: &str = "\
A file for --bones names the bones of roles; the rest is found by common names:
  {\"pelvis\": \"Hips\", \"left_thigh\": \"LeftUpLeg\", \"left_toes\": \"\"}
An empty name leaves the role without a bone. Roles are pelvis, spine, chest, upper_chest, neck, upper_neck, head, and
with left_ or right_ before them clavicle, upper_arm, forearm, hand, fingers, thigh, shin, foot, toes. A bone is named
after the part that turns with it: left_shin begins at the knee.";

/// What `--json` prints about a clip.
#[derive(Serialize)]
struct Told<'a> {
    clip: String,
    file: &'a Path,
    #[serde(flatten)]
    report: Report,
}

impl Import {
    /// Imports the motions of `--bvh` or `--smpl`.
    pub(super) fn import_skeletons(&self) -> Result<(), Error> {
        let files: Vec<&Path> = self.bvh.iter().chain(&self.smpl).map(AsRef::as_ref).collect();
        if self.name.is_some() && files.len() > 1 {
            let files = files.len();
            return Err(Error::Usage(format!("--name names one clip, but there are {files} files; leave out --name")));
        }
        let mut writer = ClipWriter::create(&self.out, self.force)?;
        let mut told = Vec::new();
        for file in files {
            let name = self.name.clone().unwrap_or_else(|| clip_name(file));
            if told.iter().any(|told: &Told| told.clip == name) {
                let message = "two files give clips of this name; rename a file, or import one with --name";
                return Err(Error::Usage(format!("{}: `{name}`: {message}", file.display())));
            }
            let (recorded, notes) = if self.smpl.is_empty() { read_bvh(file)? } else { read_smpl(file)? };
            let (clip, mut report) = self.retarget(name, &recorded)?;
            report.notes.splice(..0, notes);
            writer.add(&clip)?;
            told.push(Told { clip: clip.name, file, report });
        }
        // The file is written first: standard output may be closed.
        writer.finish()?;
        if self.json {
            return print_json(&told);
        }
        let mut text = String::new();
        for Told { clip, file, report } in &told {
            text += &format!("{clip}, from {}: {report}\n\n", file.display());
        }
        print(&format!("{text}{} in {}; see `comic-actor clips check`\n", told.len(), self.out.display()))
    }

    fn retarget(&self, name: String, recorded: &Recorded) -> Result<(Clip, Report), Error> {
        let roles = match &self.bones {
            Some(bones) => read_roles(bones, recorded)?,
            None => find_roles(recorded),
        };
        let options = Options {
            name,
            up: self.up,
            unit_meters: self.unit,
            scale: self.scale,
            frames: self.frames.clone(),
            floor: self.floor,
        };
        Ok(retarget(recorded, &roles, &options)?)
    }
}

/// The name of the clip of a file: its stem, with `_` for characters that a clip's name cannot have.
fn clip_name(path: &Path) -> String {
    let stem = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    let valid = |letter: char| if letter.is_whitespace() || "/.".contains(letter) { '_' } else { letter };
    stem.chars().map(valid).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clip_is_named_after_its_file() {
        assert_eq!(clip_name(Path::new("mocap/walk 1.bvh")), "walk_1");
        assert_eq!(clip_name(Path::new("0005_Walking001.poses.npz")), "0005_Walking001_poses");
    }
}
