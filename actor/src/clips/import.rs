//! `comic-actor clips import`.

mod skeletons;

use std::ops::Range;
use std::path::{Path, PathBuf};

use clap::Args;
use comic_clips::ClipWriter;
use comic_clips::import::{Constants, Floor, Take, import, read_manifest};
use comic_clips::retarget::{Axis, parse_unit};

use super::print;
use crate::Error;

/// Makes clips of the CMU humanoid V2020 from motion capture: ASF and AMC files of the CMU database
/// (mocap.cs.cmu.edu), BVH files of any skeleton, or recordings of AMASS (SMPL).
///
/// From ASF and AMC files the angles are copied, since the humanoid has the same skeleton. Constants that are not given
/// are computed from the recording. They are printed as options that make the same clip again. A motion of another
/// skeleton is fitted to the humanoid. Axes, unit and scale are found from it unless given. How well it fits is printed.
#[derive(Args, Clone, Debug)]
#[command(after_long_help = skeletons::HELP)]
pub(super) struct Import {
    /// The subject's skeleton.
    #[arg(long, value_name = "S.asf", requires = "amc")]
    #[arg(required_unless_present_any = ["manifest", "bvh", "smpl"])]
    asf: Option<PathBuf>,
    /// The recording.
    #[arg(long, value_name = "M.amc", group = "recording", requires = "asf")]
    #[arg(required_unless_present_any = ["manifest", "bvh", "smpl"])]
    amc: Option<PathBuf>,
    /// Motions of any skeleton; each gives a clip.
    #[arg(long, value_name = "FILE.bvh", num_args = 1.., groups = ["recording", "skeleton"])]
    bvh: Vec<PathBuf>,
    /// Motions in AMASS's layout (SMPL, SMPL-H or SMPL-X); each gives a clip.
    #[arg(long, value_name = "FILE.npz", num_args = 1.., groups = ["recording", "skeleton"])]
    smpl: Vec<PathBuf>,
    /// Which bone has which role, as a JSON or TOML object; see below. Bones with common names need no file.
    #[arg(long, value_name = "FILE", requires = "skeleton")]
    bones: Option<PathBuf>,
    /// The axis that points up in the file: x, y, z, -x, -y or -z; found from the motion unless given.
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true, requires = "skeleton")]
    up: Option<Axis>,
    /// The file's unit of length: m, cm, mm, inch, CMU (its ASF files), or its length in m; found from the leg's length unless given.
    #[arg(long, value_name = "UNIT", value_parser = parse_unit, requires = "skeleton")]
    unit: Option<f64>,
    /// The new file.
    #[arg(long, value_name = "FILE.h5")]
    out: PathBuf,
    /// Replace the file if it is there.
    #[arg(long)]
    force: bool,
    /// A JSON list of takes with their constants: all of them, or with --amc those of that recording. An object has
    /// key, asf, amc and optionally frames, sole_deg, floor, arm_reg, scale.
    #[arg(long, value_name = "FILE", conflicts_with = "skeleton")]
    manifest: Option<PathBuf>,
    /// The clip's name; CMU_002_03 for 02_03.amc, and walk_1 for "walk 1.bvh", unless given.
    #[arg(long, value_name = "CLIP", conflicts_with = "manifest")]
    name: Option<String>,
    /// Scale of the motion; the body's leg length / the subject's unless given.
    #[arg(long, value_name = "FACTOR", requires = "recording")]
    scale: Option<f64>,
    /// Degrees to subtract from the left and the right ankle, positive: toes up; computed from standing soles unless
    /// given.
    #[arg(long, value_names = ["LEFT", "RIGHT"], num_args = 2, allow_negative_numbers = true, requires = "amc")]
    sole_deg: Option<Vec<f64>>,
    /// The floor under the recording. sliding:PERCENTILE:HALF:SMOOTH follows a drifting floor, with windows in steps of
    /// 0.03 s (sliding:50:12:8). const:PERCENTILE is a level floor (const:30, for jumps). Computed from the heights unless
    /// given.
    #[arg(long, value_name = "FLOOR", requires = "recording")]
    floor: Option<Floor>,
    /// m/rad: how much arms keep their angles, rather than elbow and wrist their places, where a range is left; 0.2
    /// unless given.
    #[arg(long, value_name = "WEIGHT", requires = "amc")]
    arm_reg: Option<f64>,
    /// Recorded frames to take, counted from 0, without the last: 0..1200; all unless given.
    #[arg(long, value_name = "F0..F1", value_parser = frames, requires = "recording")]
    frames: Option<Range<usize>>,
    /// The report as JSON instead of text.
    #[arg(long, requires = "skeleton")]
    json: bool,
}

impl Import {
    pub(super) fn run(&self) -> Result<(), Error> {
        if self.bvh.is_empty() && self.smpl.is_empty() { self.import_takes() } else { self.import_skeletons() }
    }

    fn import_takes(&self) -> Result<(), Error> {
        let takes = self.takes()?;
        let mut writer = ClipWriter::create(&self.out, self.force)?;
        let mut told = String::new();
        for take in &takes {
            let (clip, taken) = import(take)?;
            for note in &taken.notes {
                tracing::warn!(clip = clip.name, "{note}");
            }
            writer.add(&clip)?;
            let (frames, seconds) = (clip.steps(), clip.dt * clip.steps() as f64);
            told += &format!("{}: {frames} frames, {seconds:.2} s, with {taken}\n", clip.name);
        }
        // The file is written first: standard output may be closed.
        writer.finish()?;
        print(&format!("{told}{} in {}; see `comic-actor clips check`\n", takes.len(), self.out.display()))
    }

    fn takes(&self) -> Result<Vec<Take>, Error> {
        let recording = self.asf.clone().zip(self.amc.clone());
        let Some(manifest) = &self.manifest else {
            let (asf, amc) = recording.unwrap_or_default();
            let name = self.name.clone().unwrap_or_else(|| name_of(&amc));
            let mut constants = Constants::default();
            self.override_in(&mut constants);
            return Ok(vec![Take { name, asf, amc, constants }]);
        };
        let mut takes = read_manifest(manifest)?;
        if let Some((asf, amc)) = recording {
            takes.retain(|take| take.amc.file_name() == amc.file_name());
            for take in &mut takes {
                (take.asf, take.amc) = (asf.clone(), amc.clone());
                self.override_in(&mut take.constants);
            }
        }
        if takes.is_empty() {
            let what =
                self.amc.as_ref().map_or_else(|| "no take".into(), |amc| format!("no take of {}", amc.display()));
            return Err(Error::Usage(format!(
                "{}: lists {what}; leave out --manifest, or complete it",
                manifest.display()
            )));
        }
        Ok(takes)
    }

    fn override_in(&self, constants: &mut Constants) {
        let pair = |degrees: &Vec<f64>| <[f64; 2]>::try_from(degrees.as_slice()).ok();
        constants.scale = self.scale.or(constants.scale);
        constants.sole_degrees = self.sole_deg.as_ref().and_then(pair).or(constants.sole_degrees);
        constants.floor = self.floor.or(constants.floor);
        constants.arm_regularisation = self.arm_reg.or(constants.arm_regularisation);
        constants.frames = self.frames.clone().or(constants.frames.take());
    }
}

fn frames(text: &str) -> Result<Range<usize>, String> {
    let range = text.split_once("..").and_then(|(first, end)| Some(first.parse().ok()?..end.parse().ok()?));
    range.filter(|range: &Range<usize>| !range.is_empty()).ok_or_else(|| "give first and end, like 0..1200".into())
}

/// dm_control's clip name for a file of the database: subject in three digits, take in two.
fn name_of(amc: &Path) -> String {
    let stem = amc.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    let numbers = stem.split_once('_').and_then(|(subject, take)| Some((subject.parse().ok()?, take.parse().ok()?)));
    match numbers {
        Some::<(u32, u32)>((subject, take)) => format!("CMU_{subject:03}_{take:02}"),
        None => stem,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recording_of_the_database_gets_dm_controls_name() {
        assert_eq!(name_of(Path::new("subjects/02/02_03.amc")), "CMU_002_03");
        assert_eq!(name_of(Path::new("131_7.amc")), "CMU_131_07");
        assert_eq!(name_of(Path::new("md_walk.amc")), "md_walk");
    }

    #[test]
    fn frames_are_a_range() {
        assert_eq!(frames("5..90"), Ok(5..90));
        for text in ["", "5", "9..5", "a..b", "-1..4"] {
            assert!(frames(text).is_err(), "{text}");
        }
    }
}
