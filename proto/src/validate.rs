//! The validation of received unrolls, before they are copied into a batch.

use std::ops::Range;

use comic_experiment::LARGEST_ACTION_GRADIENT;
use thiserror::Error;

use crate::field::Field;
use crate::layout::UnrollLayout;
use crate::pieces::Pieces;
use crate::v1::{EpisodeEnd, EpisodeStatistics, UnrollHeader};

/// Sequence numbers are below this. With a thousand unrolls per second an actor reaches it after thirty years, so a
/// larger number is an error. If it were accepted, all numbers that it skips would be counted as lost.
pub const MAX_SEQUENCE: u64 = 1 << 40;

/// The state of the learner that a header must match.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Expected<'a> {
    /// Number of clips of each task. The indices of clips continue from task to task.
    pub clips: &'a [usize],
    /// The learner epoch. An unroll of an earlier epoch is valid here; the batcher drops it as superseded.
    pub epoch: u64,
    /// The newest version of the parameters that was published in this epoch.
    pub newest_version: u64,
}

impl Expected<'_> {
    /// The indices of the clips of a task; `None` for a task that the experiment does not have.
    fn clips_of(&self, task: u32) -> Option<Range<usize>> {
        let task = task as usize;
        let first: usize = self.clips.get(..task)?.iter().sum();
        Some(first..first + self.clips.get(task)?)
    }
}

/// The reason why an unroll is invalid.
#[derive(Clone, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum Invalid {
    /// The message has no header.
    #[error("unroll has no header")]
    Header,
    /// No actor can have reached the sequence number.
    #[error("sequence number {sequence} is not below {MAX_SEQUENCE}")]
    Sequence {
        /// The received value.
        sequence: u64,
    },
    /// The layout is not that of the learner.
    #[error("layout hash differs from the learner's: actor and learner must run the same experiment, join again")]
    LayoutHash,
    /// The learner epoch has not begun.
    #[error("learner epoch {found} is in the future, the learner is in epoch {newest}")]
    Epoch {
        /// The received value.
        found: u64,
        /// The epoch of the learner.
        newest: u64,
    },
    /// The version is not published yet.
    #[error("version {found} is in the future, the newest is {newest}")]
    Version {
        /// The received value.
        found: u64,
        /// The newest published version.
        newest: u64,
    },
    /// The payload does not have the size of the layout.
    #[error("payload has {found} bytes, but the layout has {expected}")]
    Length {
        /// Received bytes.
        found: usize,
        /// Bytes of the layout.
        expected: usize,
    },
    /// A number is NaN or infinite.
    #[error("{field}[{row}] is not finite")]
    NotFinite {
        /// The field.
        field: Field,
        /// The row.
        row: usize,
    },
    /// A finite number is outside the range of the field.
    #[error("{field}[{row}] = {value}, expected {expected}")]
    Range {
        /// The field.
        field: Field,
        /// The row.
        row: usize,
        /// The received value.
        value: f32,
        /// The allowed range.
        expected: &'static str,
    },
    /// The weights of a mixture do not add up to 1.
    #[error("the weights of row {row} add up to {sum}, expected 1")]
    Weights {
        /// The row.
        row: usize,
        /// Their sum.
        sum: f32,
    },
    /// The end of an episode and the beginning of the next one do not match.
    #[error("valid[{row}] and first[{next}] contradict each other: an episode begins exactly after a row without a transition", next = row + 1)]
    Boundary {
        /// The row of `valid`.
        row: usize,
    },
    /// The experiment does not have the task.
    #[error("the header names task {task}, but the experiment has {tasks} tasks, counted from 0")]
    Task {
        /// The received value.
        task: u32,
        /// Number of tasks.
        tasks: usize,
    },
    /// A clip does not belong to the task of the header.
    #[error("clip {clip} in row {row} does not belong to task {task} of the header")]
    Clip {
        /// The received value.
        clip: u32,
        /// The row.
        row: usize,
        /// The task of the header.
        task: u32,
    },
    /// More episodes ended than possible in one unroll.
    #[error("{found} episodes ended in one unroll, at most {limit} can")]
    Episodes {
        /// The received value.
        found: usize,
        /// T + 1.
        limit: usize,
    },
    /// The statistics of an episode are invalid.
    #[error("episode statistics: {problem}")]
    Episode {
        /// What is wrong.
        problem: &'static str,
    },
}

/// MuJoCo's limit (`mjMAXVAL`): a simulation with larger numbers has diverged.
const LARGEST_OBSERVATION: f32 = 1e10;
/// With this limit the square of a number divided by [`SMALLEST_STD`] does not overflow a float32.
const LARGEST_NUMBER: f32 = 1e6;
/// Float32 sums of a softmax differ from 1 by less than this.
const WEIGHTS_TOLERANCE: f32 = 1e-3;
/// The least standard deviation that an experiment may have.
const SMALLEST_STD: f32 = 1e-6;

/// Checks header and payload of an unroll against the layout and the state of the learner.
///
/// # Errors
/// The first [`Invalid`] that is found.
pub fn validate(
    layout: &UnrollLayout,
    header: &UnrollHeader,
    payload: &Pieces,
    expected: &Expected<'_>,
) -> Result<(), Invalid> {
    let clips = check_header(layout, header, expected)?;
    if payload.len() != layout.size() {
        return Err(Invalid::Length { found: payload.len(), expected: layout.size() });
    }
    for (field, limit, expected) in [
        (Field::Proprioception, LARGEST_OBSERVATION, "within ±1e10"),
        (Field::Task, LARGEST_OBSERVATION, "within ±1e10"),
        (Field::PreviousLatent, LARGEST_NUMBER, "within ±1e6"),
        (Field::LatentNoise, LARGEST_NUMBER, "within ±1e6"),
        (Field::Action, LARGEST_NUMBER, "within ±1e6"),
        (Field::Mean, LARGEST_NUMBER, "within ±1e6"),
        (Field::LogWeights, LARGEST_NUMBER, "within ±1e6"),
        (Field::ActionGradient, LARGEST_ACTION_GRADIENT, "within ±1e3"),
        (Field::Reward, LARGEST_NUMBER, "within ±1e6"),
        (Field::State, LARGEST_NUMBER, "within ±1e6"),
    ] {
        check_range(layout, payload, field, expected, |value| value.abs() <= limit)?;
    }
    check_range(layout, payload, Field::Std, "1e-6 to 1e6", |value| (SMALLEST_STD..=LARGEST_NUMBER).contains(&value))?;
    check_range(layout, payload, Field::Discount, "0 to 1", |value| (0.0..=1.0).contains(&value))?;
    check_range(layout, payload, Field::Valid, "0 or 1", |value| value == 0.0 || value == 1.0)?;
    check_range(layout, payload, Field::First, "0 or 1", |value| value == 0.0 || value == 1.0)?;
    check_weights(layout, payload)?;
    check_boundaries(layout, payload)?;
    check_clips(layout, header, payload, &clips)
}

/// Checks the header and returns the clips of its task.
fn check_header(
    layout: &UnrollLayout,
    header: &UnrollHeader,
    expected: &Expected<'_>,
) -> Result<Range<usize>, Invalid> {
    if header.sequence >= MAX_SEQUENCE {
        return Err(Invalid::Sequence { sequence: header.sequence });
    }
    if header.layout_hash != layout.hash() {
        return Err(Invalid::LayoutHash);
    }
    if header.learner_epoch > expected.epoch {
        return Err(Invalid::Epoch { found: header.learner_epoch, newest: expected.epoch });
    }
    // The versions of another epoch cannot be compared.
    if header.learner_epoch == expected.epoch && header.version > expected.newest_version {
        return Err(Invalid::Version { found: header.version, newest: expected.newest_version });
    }
    if header.episodes.len() > layout.max_episodes() {
        return Err(Invalid::Episodes { found: header.episodes.len(), limit: layout.max_episodes() });
    }
    let clips =
        expected.clips_of(header.task).ok_or(Invalid::Task { task: header.task, tasks: expected.clips.len() })?;
    header.episodes.iter().try_for_each(|episode| check_episode(layout, episode, &clips))?;
    Ok(clips)
}

fn check_episode(layout: &UnrollLayout, episode: &EpisodeStatistics, clips: &Range<usize>) -> Result<(), Invalid> {
    let end = EpisodeEnd::try_from(episode.end).unwrap_or(EpisodeEnd::Unspecified);
    let problem = if !clips.contains(&(episode.clip as usize)) {
        "its clip does not belong to the task of the header"
    } else if episode.steps == 0 || episode.steps_left_at_start == 0 {
        "an episode has at least one step and at least one step left at its start"
    } else if episode.returns.len() != layout.shape().reward_terms {
        "the number of returns is not the number of reward terms"
    } else if !episode.returns.iter().all(|value| value.is_finite()) {
        "a return is not finite"
    } else if !episode.head_height.is_none_or(f32::is_finite) {
        "the height of the head is not finite"
    } else if end == EpisodeEnd::Unspecified {
        "the end of the episode is unspecified"
    } else {
        return Ok(());
    };
    Err(Invalid::Episode { problem })
}

/// The words of a field. It allocates, so it is only for fields with few elements or invalid ones.
fn words(layout: &UnrollLayout, payload: &Pieces, field: Field) -> Vec<u32> {
    let mut words = Vec::with_capacity(layout.elements(field));
    payload.for_each_word(layout.range(field), |word| words.push(word));
    words
}

fn floats(layout: &UnrollLayout, payload: &Pieces, field: Field) -> Vec<f32> {
    words(layout, payload, field).into_iter().map(f32::from_bits).collect()
}

/// Checks that all numbers of a field are allowed. A first pass only finds whether one is not; then a second pass finds
/// which one.
fn check_range(
    layout: &UnrollLayout,
    payload: &Pieces,
    name: Field,
    expected: &'static str,
    allowed: impl Fn(f32) -> bool,
) -> Result<(), Invalid> {
    // Without an early exit the loop is vectorised. NaN is in no range.
    let mut is_invalid = false;
    payload.for_each_word(layout.range(name), |word| is_invalid |= !allowed(f32::from_bits(word)));
    if !is_invalid {
        return Ok(());
    }
    let first = floats(layout, payload, name).into_iter().enumerate().find(|(_, value)| !allowed(*value));
    first.map_or(Ok(()), |(index, value)| {
        let row = index / layout.width(name).max(1);
        Err(match value.is_finite() {
            true => Invalid::Range { field: name, row, value, expected },
            false => Invalid::NotFinite { field: name, row },
        })
    })
}

fn check_weights(layout: &UnrollLayout, payload: &Pieces) -> Result<(), Invalid> {
    let components = layout.width(Field::LogWeights);
    let logarithms = floats(layout, payload, Field::LogWeights);
    for (row, weights) in logarithms.chunks_exact(components.max(1)).enumerate() {
        let sum: f32 = weights.iter().map(|weight| weight.exp()).sum();
        if (sum - 1.0).abs() > WEIGHTS_TOLERANCE {
            return Err(Invalid::Weights { row, sum });
        }
    }
    Ok(())
}

fn check_boundaries(layout: &UnrollLayout, payload: &Pieces) -> Result<(), Invalid> {
    let (valid, first) = (floats(layout, payload, Field::Valid), floats(layout, payload, Field::First));
    let next_first = first.iter().skip(1);
    match valid.iter().zip(next_first).position(|(valid, first)| (*valid == 0.0) != (*first == 1.0)) {
        Some(row) => Err(Invalid::Boundary { row }),
        None => Ok(()),
    }
}

fn check_clips(
    layout: &UnrollLayout,
    header: &UnrollHeader,
    payload: &Pieces,
    clips: &Range<usize>,
) -> Result<(), Invalid> {
    let found = words(layout, payload, Field::Clip);
    match found.iter().position(|clip| !clips.contains(&(*clip as usize))) {
        Some(row) => Err(Invalid::Clip { clip: found[row], row, task: header.task }),
        None => Ok(()),
    }
}
