//! The card of a low level: what people should know before they use it (Mitchell et al., Model Cards, 2019).

use serde::{Deserialize, Serialize};

/// How a low level was made and what it does. No program depends on it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Card {
    /// The command that makes such a low level again.
    pub command: String,
    /// The terms under which the recordings may be used that it was learned from.
    pub terms: String,
    /// The policy that it was taken from, which followed its clips.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evaluation: Option<Evaluation>,
    /// What it does with random latents.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub assessment: Option<Assessment>,
}

/// The part of what `comic-actor assess --json` prints that a card keeps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Assessment {
    /// One for each source of latents.
    pub rows: Vec<RandomLatents>,
    /// The verdict; `None` if the low level has no prior of the state.
    pub gate: Option<Gate>,
}

/// Whether a new policy can explore with random latents of the prior.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Gate {
    /// Whether every check is passed.
    pub passed: bool,
}

/// An evaluation, as `comic-actor evaluate --json` prints it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Whether actions and latents were the means instead of samples.
    pub deterministic: bool,
    /// One for each clip.
    pub clips: Vec<ClipEvaluation>,
    /// Over all episodes of all clips.
    pub overall: ClipEvaluation,
}

/// Means over the episodes of one clip, or of all clips.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClipEvaluation {
    /// The clip's name; `overall` for all of them.
    pub clip: String,
    /// Number of episodes.
    pub episodes: u64,
    /// Mean of return / (largest reward of a step × steps left at the start).
    pub normalised_reward: f64,
    /// Mean of steps / steps left in the clip at the start.
    pub fraction_survived: f64,
}

/// A low level with random latents from one source.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RandomLatents {
    /// The source of the latents.
    pub latents: String,
    /// Number of episodes.
    pub episodes: u64,
    /// Mean seconds until the head is below 1.2 m, or until the time limit.
    pub seconds_upright: f64,
    /// Their median.
    pub median_seconds_upright: f64,
    /// Share of the episodes that are upright at the time limit.
    pub upright_to_the_end: f64,
    /// Mean horizontal distance between the start and the place where the episode ended, m.
    pub metres: f64,
    /// Circular standard deviation of the headings after 3 s, degrees; `None` if too few episodes are upright then.
    pub heading_std: Option<f64>,
}
