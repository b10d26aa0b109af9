//! `comic-actor clips check`.

use clap::Args;
use comic_clips::check::{
    AIRBORNE, Checked, DEEP_PENETRATION, HIGHEST_JUMP, JOINT_EXCESS, JOINT_SPEED, LEAST_FALL, LONGEST_FLIGHT,
    MOST_FALL, MOST_JUMPS, OVERHANG, PENETRATION, ROOT_SPEED, ROOT_TURN, SHORTEST_FLIGHT, STILL, STILL_TIME, check,
};
use comic_experiment::ClipSource;

use super::{print, print_json, table::table};
use crate::Error;

/// Finds every defect of every clip; exits with 1 when there is any.
///
/// Where no policy can follow a clip, the defect's description says that it cannot be followed.
///
/// Joint limits, floor, flights and balance are those of the CMU humanoid V2020. Clips of another body are checked for other
/// defects only.
#[derive(Args, Clone, Debug)]
#[command(after_long_help = help())]
pub(super) struct Check {
    /// The file, or FILE.h5#CLIP,CLIP or FILE.h5#SUBSET.
    #[arg(value_name = "FILE")]
    file: String,
    /// JSON instead of a table; see below.
    #[arg(long)]
    json: bool,
}

fn help() -> String {
    format!(
        "\
Defects, by limits of this project's choice:
  unreadable       a dataset or attribute is missing, mis-shaped or damaged
  not_finite       NaN or infinity
  quaternion_norm  a quaternion's norm is off 1 by 0.01 or more
  joint_limit      a joint is over {JOINT_EXCESS} rad outside its range
  penetration      a geom is over {PENETRATION} m deep in the floor, z = 0; over {DEEP_PENETRATION} m cannot be followed,
                   except for hands, fingers, thumbs and toes

Defects that cannot be followed. A flight is {SHORTEST_FLIGHT} s or more with the whole body over {AIRBORNE} m above the floor:
  floating         a flight in which the centre of mass falls with under {LEAST_FALL} g, or one of over {LONGEST_FLIGHT} s
  fall             a flight in which the centre of mass falls with over {MOST_FALL} g
  jump_height      a flight in which the centre of mass rises by over {HIGHEST_JUMP} m
  unbalanced       for over {STILL_TIME} s the centre of mass is slower than {STILL} m/s and over {OVERHANG} m beside all that
                   touches the floor
  jump             from one frame to the next faster than {ROOT_SPEED} m/s or {ROOT_TURN} rad/s (root), {JOINT_SPEED} rad/s (joint);
                   a joint that does so in up to {MOST_JUMPS} frames can be followed

With --json one array goes to standard output, an object for each clip:
  clip, frames   name and number of frames
  body_checked   whether joints, floor, flights and balance were checked
  lowest_point   [lowest, highest] of the heights of the body's lowest point, m, or null
  defects        objects: kind (as above), item (dataset, joint, geom or root), frames (in how many), first_frame,
                 worst (in m, rad, m/s, rad/s, m/s² or a count, as the kind has it), detail (in words)"
    )
}

impl Check {
    pub(super) fn run(&self) -> Result<(), Error> {
        let source = ClipSource::parse(&self.file);
        if source.source.starts_with("builtin:") {
            let what = "built-in clips are checked by the project's own tests: name an HDF5 file";
            return Err(Error::Usage(format!("{}: {what}", source.source)));
        }
        let mut chosen = source.ids;
        if let Some(subset) = &source.subset {
            chosen.extend(comic_clips::subset(subset)?);
        }
        let checked = check(source.source.as_ref(), &chosen)?;
        if self.json {
            print_json(&checked)?;
        } else {
            print(&as_table(&checked))?;
        }
        match checked.iter().filter(|clip| !clip.defects.is_empty()).count() {
            0 => Ok(()),
            clips => Err(Error::Defects { clips, of: checked.len() }),
        }
    }
}

fn as_table(checked: &[Checked]) -> String {
    let mut rows = Vec::new();
    for clip in checked {
        let millimetres = |height: f64| format!("{:.0}", 1000.0 * height);
        let [low, high] = clip.lowest_point.map_or_else(|| ["-".into(), "-".into()], |bounds| bounds.map(millimetres));
        let row = |defect: String, item: String, frames: String, first: String, detail: String| {
            [clip.clip.clone(), clip.frames.to_string(), low.clone(), high.clone(), defect, item, frames, first, detail]
        };
        if clip.defects.is_empty() {
            let said = if clip.body_checked { "sound" } else { "sound, as far as its body is known" };
            rows.push(row("-".into(), String::new(), String::new(), String::new(), said.into()));
        }
        for defect in &clip.defects {
            // The name in JSON.
            let kind = serde_json::to_value(defect.kind).ok().and_then(|kind| kind.as_str().map(String::from));
            rows.push(row(
                kind.unwrap_or_default(),
                defect.item.clone(),
                defect.frames.to_string(),
                defect.first_frame.to_string(),
                defect.detail.clone(),
            ));
        }
    }
    table(["clip", "frames", "low mm", "high mm", "defect", "at", "in frames", "first", "what"], &rows)
}
