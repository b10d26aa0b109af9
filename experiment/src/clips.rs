//! Where reference motion comes from.

use serde::{Deserialize, Serialize};

/// A source of reference motion: a built-in clip, or a file in dm_control's HDF5 layout.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClipSource {
    /// `builtin:NAME`, or the path of an HDF5 file.
    pub source: String,
    /// One of dm_control's named subsets: `walk_tiny`, `run_jump_tiny`, `get_up`, `locomotion_small`, `all`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub subset: Option<String>,
    /// Names of clips in the file. An empty list means every clip of the file or of the subset.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ids: Vec<String>,
    /// First frame used, counted from the clip's start.
    #[serde(default)]
    pub start_step: usize,
    /// Last frame used; the clip's end when absent. As in dm_control, the reference includes this frame, and no episode
    /// starts at it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub end_step: Option<usize>,
    /// Weight of every start frame of these clips when an episode's start is drawn.
    #[serde(default = "one")]
    pub weight: f64,
}

fn one() -> f64 {
    1.0
}

impl ClipSource {
    /// All clips of one source, with weight 1.
    pub fn whole(source: impl Into<String>) -> Self {
        Self { source: source.into(), subset: None, ids: Vec::new(), start_step: 0, end_step: None, weight: 1.0 }
    }

    /// Reads the command line's form: `SOURCE`, or `SOURCE#SELECTION`. The selection is a named subset, or clip names with
    /// commas between them. Examples: `builtin:walk`, `cmu.h5#walk_tiny`, `cmu.h5#CMU_007_01,CMU_002_03`.
    pub fn parse(argument: &str) -> Self {
        match argument.rsplit_once('#') {
            Some((source, selection)) if SUBSETS.contains(&selection) => {
                Self { subset: Some(selection.into()), ..Self::whole(source) }
            }
            Some((source, selection)) => {
                Self { ids: selection.split(',').map(String::from).collect(), ..Self::whole(source) }
            }
            None => Self::whole(argument),
        }
    }
}

/// dm_control's named subsets of the CMU clips (`cmu_subsets.py`).
pub const SUBSETS: [&str; 5] = ["walk_tiny", "run_jump_tiny", "get_up", "locomotion_small", "all"];
