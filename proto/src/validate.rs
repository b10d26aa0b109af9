//! What comes off the wire is checked here, before it touches a batch.

use std::ops::Range;

use thiserror::Error;

use crate::v1::{Behaviour, EpisodeEnd, EpisodeStatistics, UnrollHeader};
use crate::{Field, Pieces, UnrollLayout};

/// Sequence numbers lie below this. At a thousand unrolls a second an actor reaches it after thirty years; a larger
/// one is a broken header, and one such number taken seriously would spoil the accounting.
pub const MAX_SEQUENCE: u64 = 1 << 40;

/// What the learner knows at this moment and a header has to agree with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Expected<'a> {
    /// Number of clips of each task. Clips are numbered through all tasks.
    pub clips: &'a [usize],
    /// The learner's epoch. An unroll of an earlier one is not invalid but superseded, which is the batcher's to say.
    pub epoch: u64,
    /// The newest version of the parameters that was published in this epoch.
    pub newest_version: u64,
}

impl Expected<'_> {
    /// The clips of a task; none for a task that the experiment does not have.
    fn clips_of(&self, task: u32) -> Option<Range<usize>> {
        let task = task as usize;
        let first: usize = self.clips.get(..task)?.iter().sum();
        Some(first..first + self.clips.get(task)?)
    }
}

/// Why an unroll is refused as invalid.
#[derive(Clone, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum Invalid {
    /// The message has no header.
    #[error("unroll has no header")]
    Header,
    /// A sequence number that no actor can have reached.
    #[error("sequence {sequence} is beyond {MAX_SEQUENCE}")]
    Sequence {
        /// As received.
        sequence: u64,
    },
    /// Another layout than this learner's.
    #[error("layout hash differs from the learner's: actor and learner must run the same experiment, join again")]
    LayoutHash,
    /// An epoch that has not begun.
    #[error("learner epoch {found} is in the future, this is epoch {newest}")]
    Epoch {
        /// As received.
        found: u64,
        /// The learner's.
        newest: u64,
    },
    /// A version that was never published.
    #[error("version {found} is in the future, the newest is {newest}")]
    Version {
        /// As received.
        found: u64,
        /// The newest published.
        newest: u64,
    },
    /// Not the layout's size.
    #[error("payload has {found} bytes, the layout {expected}")]
    Length {
        /// Bytes received.
        found: usize,
        /// Bytes of the layout.
        expected: usize,
    },
    /// NaN or infinity.
    #[error("{field}[{row}] is not finite")]
    NotFinite {
        /// The field.
        field: Field,
        /// The row.
        row: usize,
    },
    /// A finite number outside the field's range.
    #[error("{field}[{row}] = {value}, expected {expected}")]
    Range {
        /// The field.
        field: Field,
        /// The row.
        row: usize,
        /// As received.
        value: f32,
        /// What is allowed.
        expected: &'static str,
    },
    /// A mixture's weights that do not add up to 1.
    #[error("the weights of row {row} add up to {sum}, expected 1")]
    Weights {
        /// The row.
        row: usize,
        /// Their sum.
        sum: f32,
    },
    /// An episode's end and the next one's beginning do not match.
    #[error("valid[{row}] and first[{next}] contradict each other: an episode begins exactly after a row without a transition", next = row + 1)]
    Boundary {
        /// The row of `valid`.
        row: usize,
    },
    /// No behaviour, or one that this learner does not know.
    #[error("the header names no known behaviour: {behaviour}")]
    Behaviour {
        /// As received.
        behaviour: i32,
    },
    /// A task that the experiment does not have.
    #[error("the header names task {task}, but the experiment has {tasks} tasks, counted from 0")]
    Task {
        /// As received.
        task: u32,
        /// Number of tasks.
        tasks: usize,
    },
    /// A clip that does not belong to the header's task.
    #[error("clip {clip} in row {row} does not belong to task {task} of the header")]
    Clip {
        /// As received.
        clip: u32,
        /// The row.
        row: usize,
        /// The header's task.
        task: u32,
    },
    /// More episodes than an unroll has room for.
    #[error("{found} episodes ended in one unroll, at most {limit} can")]
    Episodes {
        /// As received.
        found: usize,
        /// T + 1.
        limit: usize,
    },
    /// An episode's statistics make no sense.
    #[error("episode statistics: {problem}")]
    Episode {
        /// Which number is wrong.
        problem: &'static str,
    },
}

/// MuJoCo's own limit (`mjMAXVAL`): a simulation beyond it has diverged.
const LARGEST_OBSERVATION: f32 = 1e10;
/// No squared ratio of two of these overflows a float32 where the deviation is at least [`SMALLEST_STD`].
const LARGEST_NUMBER: f32 = 1e6;
/// Float32 sums of a softmax are this close to 1, and closer.
const WEIGHTS_TOLERANCE: f32 = 1e-3;
/// The least standard deviation an experiment may ask for.
const SMALLEST_STD: f32 = 1e-6;

/// Checks header and payload of an unroll against everything both sides agreed on.
///
/// # Errors
/// The first [`Invalid`] found.
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
    if header.behaviour() == Behaviour::Unspecified {
        return Err(Invalid::Behaviour { behaviour: header.behaviour });
    }
    if header.learner_epoch > expected.epoch {
        return Err(Invalid::Epoch { found: header.learner_epoch, newest: expected.epoch });
    }
    // Versions of another epoch cannot be compared with this one's.
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
        "its clip does not belong to the header's task"
    } else if episode.steps == 0 || episode.steps_left_at_start == 0 {
        "an episode has at least one step and at least one step left at its start"
    } else if episode.returns.len() != layout.shape().reward_terms {
        "one return for each reward term is needed"
    } else if !episode.returns.iter().all(|value| value.is_finite()) {
        "a return is not finite"
    } else if !episode.head_height.is_none_or(f32::is_finite) {
        "the head's height is not finite"
    } else if end == EpisodeEnd::Unspecified {
        "how the episode ended is missing"
    } else {
        return Ok(());
    };
    Err(Invalid::Episode { problem })
}

/// The words of a field that has a few in a row.
fn words(layout: &UnrollLayout, payload: &Pieces, field: Field) -> Vec<u32> {
    let mut words = Vec::with_capacity(layout.elements(field));
    payload.for_each_word(layout.range(field), |word| words.push(word));
    words
}

fn floats(layout: &UnrollLayout, payload: &Pieces, field: Field) -> Vec<f32> {
    words(layout, payload, field).into_iter().map(f32::from_bits).collect()
}

/// One pass finds whether all is as it should be; only when it is not does a second one look for the place.
fn check_range(
    layout: &UnrollLayout,
    payload: &Pieces,
    name: Field,
    expected: &'static str,
    allowed: impl Fn(f32) -> bool,
) -> Result<(), Invalid> {
    // No early exit: without one this is a handful of vector instructions per cache line. No NaN is in any range.
    let mut broken = false;
    payload.for_each_word(layout.range(name), |word| broken |= !allowed(f32::from_bits(word)));
    if !broken {
        return Ok(());
    }
    let place = floats(layout, payload, name).into_iter().enumerate().find(|(_, value)| !allowed(*value));
    place.map_or(Ok(()), |(place, value)| {
        let row = place / layout.width(name).max(1);
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
