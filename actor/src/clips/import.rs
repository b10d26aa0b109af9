//! `comic-actor clips import`.

use std::ops::Range;
use std::path::{Path, PathBuf};

use clap::Args;
use comic_clips::ClipWriter;
use comic_clips::import::{Constants, Floor, Take, import, read_manifest};

use super::print;
use crate::Error;

/// Makes clips of the CMU humanoid V2020 from ASF and AMC files of the CMU database (mocap.cs.cmu.edu), 120 frames a
/// second.
///
/// Constants that are not given are computed from the recording. They are printed as options that make the same clip
/// again.
#[derive(Args, Clone, Debug)]
pub(super) struct Import {
    /// The subject's skeleton.
    #[arg(long, value_name = "S.asf", requires = "amc", required_unless_present = "manifest")]
    asf: Option<PathBuf>,
    /// The recording.
    #[arg(long, value_name = "M.amc", requires = "asf", required_unless_present = "manifest")]
    amc: Option<PathBuf>,
    /// The new file.
    #[arg(long, value_name = "FILE.h5")]
    out: PathBuf,
    /// Replace the file if it is there.
    #[arg(long)]
    force: bool,
    /// A JSON list of takes with their constants: all of them, or with --amc those of that recording. An object has
    /// key, asf, amc and optionally frames, sole_deg, floor, arm_reg, scale.
    #[arg(long, value_name = "FILE")]
    manifest: Option<PathBuf>,
    /// The clip's name; CMU_002_03 for 02_03.amc unless given.
    #[arg(long, value_name = "CLIP", conflicts_with = "manifest")]
    name: Option<String>,
    /// Scale of the motion; the body's leg length / the subject's unless given.
    #[arg(long, value_name = "FACTOR", requires = "amc")]
    scale: Option<f64>,
    /// Degrees to subtract from the left and the right ankle, positive: toes up; computed from standing soles unless
    /// given.
    #[arg(long, value_names = ["LEFT", "RIGHT"], num_args = 2, allow_negative_numbers = true, requires = "amc")]
    sole_deg: Option<Vec<f64>>,
    /// The floor under the recording. sliding:PERCENTILE:HALF:SMOOTH follows a drifting floor, with windows in steps of
    /// 0.03 s (sliding:50:12:8). const:PERCENTILE is a level floor (const:30, for jumps). Computed from the heights unless
    /// given.
    #[arg(long, value_name = "FLOOR", requires = "amc")]
    floor: Option<Floor>,
    /// m/rad: how much arms keep their angles, rather than elbow and wrist their places, where a range is left; 0.2
    /// unless given.
    #[arg(long, value_name = "WEIGHT", requires = "amc")]
    arm_reg: Option<f64>,
    /// Recorded frames to take, counted from 0, without the last: 0..1200; all unless given.
    #[arg(long, value_name = "F0..F1", value_parser = frames, requires = "amc")]
    frames: Option<Range<usize>>,
}

impl Import {
    pub(super) fn run(&self) -> Result<(), Error> {
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
