//! Where each field of an unroll lies in the payload.

use std::fmt::{self, Write as _};
use std::ops::Range;

use comic_experiment::{Experiment, TaskSpec};
use sha2::{Digest, Sha256};

use crate::PerField;

/// Bytes of an element of every field but the image, whose elements are bytes.
const ELEMENT: usize = 4;
/// Room in a message for everything of fixed size around payload and episode statistics.
const HEADER_SLACK: usize = 4096;
/// Room for one episode's statistics without its returns: a few varints and tags.
const EPISODE_SLACK: usize = 64;

/// The sizes an unroll is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct UnrollShape {
    /// T: transitions.
    pub length: usize,
    /// P: proprioception.
    pub proprioception: usize,
    /// X: task observation.
    pub task: usize,
    /// A: action.
    pub action: usize,
    /// Z: latent.
    pub latent: usize,
    /// R: reward terms.
    pub reward_terms: usize,
    /// I: bytes of an image, a multiple of 4; 0 when the humanoid is blind.
    pub image: usize,
    /// K: Gaussians that the behaviour policy's distribution is a mixture of.
    pub components: usize,
    /// S: numbers that the policy remembers from step to step; 0 when it remembers nothing.
    pub state: usize,
}

impl UnrollShape {
    /// The unrolls of this task under this experiment.
    pub fn new(spec: &TaskSpec, experiment: &Experiment) -> Self {
        Self {
            length: experiment.unroll.length,
            proprioception: spec.proprioception,
            task: spec.task,
            action: spec.action,
            latent: experiment.network.latent.size,
            reward_terms: spec.reward_terms.len(),
            // Whole words keep every row aligned.
            image: spec.image.next_multiple_of(ELEMENT),
            components: experiment.network.components(),
            state: experiment.network.state_size(),
        }
    }

    /// Elements in a row of this field.
    pub fn width(&self, field: Field) -> usize {
        field.width(self)
    }
}

/// One array of an unroll; the order here is the order in the payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Field {
    /// `[T+1, P]` f32: what the body feels of itself, SI units.
    Proprioception,
    /// `[T+1, X]` f32: the task observation.
    Task,
    /// `[T, Z]` f32: z of the step before; zero at an episode's first step.
    PreviousLatent,
    /// `[T, Z]` f32: the standard-normal noise that made z.
    LatentNoise,
    /// `[T, A]` f32: the action as sampled, not clipped.
    Action,
    /// `[T, K·A]` f32: mean of each component of the behaviour policy.
    Mean,
    /// `[T, K·A]` f32, positive: standard deviation of each component of the behaviour policy.
    Std,
    /// `[T, K]` f32: ln of the components' weights, which add up to 1; absent where there is one component.
    LogWeights,
    /// `[T, R]` f32: one column for each reward term.
    Reward,
    /// `[T]` f32 in [0, 1]: 0 where the step terminated the episode, 1 elsewhere.
    Discount,
    /// `[T]` f32, 1 or 0: whether the row holds a transition.
    Valid,
    /// `[T+1]` f32, 1 or 0: whether the row is an episode's first observation.
    First,
    /// `[1, S]` f32: what the policy remembers when it meets the first observation.
    State,
    /// `[T+1]` u32: the clip's index.
    Clip,
    /// `[T+1, I]` u8: what the humanoid sees, rows from the top, red, green, blue.
    Image,
}

impl Field {
    /// Every field, in payload order.
    pub const ALL: [Self; 15] = [
        Self::Proprioception,
        Self::Task,
        Self::PreviousLatent,
        Self::LatentNoise,
        Self::Action,
        Self::Mean,
        Self::Std,
        Self::LogWeights,
        Self::Reward,
        Self::Discount,
        Self::Valid,
        Self::First,
        Self::State,
        Self::Clip,
        Self::Image,
    ];

    /// Its name in layout descriptions and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Proprioception => "proprioception",
            Self::Task => "task",
            Self::PreviousLatent => "previous_latent",
            Self::LatentNoise => "latent_noise",
            Self::Action => "action",
            Self::Mean => "mean",
            Self::Std => "std",
            Self::LogWeights => "log_weights",
            Self::Reward => "reward",
            Self::Discount => "discount",
            Self::Valid => "valid",
            Self::First => "first",
            Self::State => "state",
            Self::Clip => "clip",
            Self::Image => "image",
        }
    }

    /// Rows in an unroll of `length` transitions: T, T + 1 or 1.
    pub fn rows(self, length: usize) -> usize {
        match self {
            Self::Proprioception | Self::Task | Self::First | Self::Clip | Self::Image => length.saturating_add(1),
            Self::State => 1,
            _ => length,
        }
    }

    /// Elements of a row.
    pub fn width(self, shape: &UnrollShape) -> usize {
        match self {
            Self::Proprioception => shape.proprioception,
            Self::Task => shape.task,
            Self::PreviousLatent | Self::LatentNoise => shape.latent,
            Self::Action => shape.action,
            Self::Mean | Self::Std => shape.components.saturating_mul(shape.action),
            Self::LogWeights if shape.components > 1 => shape.components,
            Self::LogWeights => 0,
            Self::State => shape.state,
            Self::Reward => shape.reward_terms,
            Self::Discount | Self::Valid | Self::First | Self::Clip => 1,
            Self::Image => shape.image,
        }
    }

    /// What stands in a row that holds no transition, where nothing was decided: numbers that no formula can fail on.
    /// `None` where such a row has a meaning of its own, as its observation has.
    pub fn blank(self, shape: &UnrollShape) -> Option<f64> {
        match self {
            Self::PreviousLatent | Self::LatentNoise | Self::Action | Self::Mean | Self::Reward => Some(0.0),
            Self::Std => Some(1.0),
            Self::LogWeights => Some(-(shape.components as f64).ln()),
            Self::Proprioception
            | Self::Task
            | Self::Discount
            | Self::Valid
            | Self::First
            | Self::State
            | Self::Clip
            | Self::Image => None,
        }
    }

    fn element(self) -> &'static str {
        match self {
            Self::Clip => "u32",
            Self::Image => "u8",
            _ => "f32",
        }
    }

    /// Bytes of an element.
    fn element_bytes(self) -> usize {
        if self == Self::Image { 1 } else { ELEMENT }
    }
}

impl fmt::Display for Field {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

/// Where every field of an unroll lies in the payload, and the hash by which both sides know they agree.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnrollLayout {
    shape: UnrollShape,
    ranges: PerField<(usize, usize)>,
    hash: [u8; 32],
}

impl UnrollLayout {
    /// The layout of unrolls of this shape.
    pub fn new(shape: UnrollShape) -> Self {
        let mut ranges = PerField::default();
        let mut description = format!("comic unroll layout 3, little-endian, T={}\n", shape.length);
        let mut start = 0usize;
        for (field, range) in ranges.iter_mut() {
            let (rows, width) = (field.rows(shape.length), field.width(&shape));
            let end = start.saturating_add(rows.saturating_mul(width).saturating_mul(field.element_bytes()));
            *range = (start, end);
            start = end;
            // Writing to a String cannot fail.
            let _ = writeln!(description, "{field} {rows} {width} {}", field.element());
        }
        Self { shape, ranges, hash: Sha256::digest(description).into() }
    }

    /// The shape it was made from.
    pub fn shape(&self) -> &UnrollShape {
        &self.shape
    }

    /// Bytes of a payload.
    pub fn size(&self) -> usize {
        self.range(Field::Image).end
    }

    /// SHA-256 over a canonical description: format version, T, and each field's name, rows, width and type.
    pub fn hash(&self) -> [u8; 32] {
        self.hash
    }

    /// The bytes of a payload in which this field lies.
    pub fn range(&self, field: Field) -> Range<usize> {
        let (start, end) = self.ranges[field];
        start..end
    }

    /// Elements a row.
    pub fn width(&self, field: Field) -> usize {
        field.width(&self.shape)
    }

    /// Rows: T, T + 1 or 1.
    pub fn rows(&self, field: Field) -> usize {
        field.rows(self.shape.length)
    }

    /// Elements of the whole field, rows × width.
    pub fn elements(&self, field: Field) -> usize {
        self.range(field).len() / field.element_bytes()
    }

    /// The most episodes that can end in one unroll: each has its last observation in a row of its own.
    pub fn max_episodes(&self) -> usize {
        self.shape.length.saturating_add(1)
    }

    /// The largest `UnrollMessage` that can be valid, in bytes: what a server sets as its decoding limit.
    pub fn message_limit(&self) -> usize {
        let episode = self.shape.reward_terms.saturating_mul(ELEMENT).saturating_add(EPISODE_SLACK);
        self.size().saturating_add(self.max_episodes().saturating_mul(episode)).saturating_add(HEADER_SLACK)
    }
}
