//! Sizes and initial values of the networks.

use serde::{Deserialize, Serialize};

/// Sizes and initial values of every network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Network {
    /// Hidden sizes of the reference encoder (S: 2×1024).
    pub encoder: Vec<usize>,
    /// Adds a linear path from the encoder's input to its output (S: with the MLP low level). Not used without a
    /// bottleneck.
    pub encoder_linear_path: bool,
    /// The low level, which turns latent and proprioception into an action. The section of the same name holds its sizes.
    pub low_level: LowLevelName,
    /// The MLP low level.
    pub mlp: Mlp,
    /// The LSTM low level.
    pub lstm: Lstm,
    /// The primitives of the mixture and of the product.
    pub primitives: Primitives,
    /// Hidden sizes of the value function (S: 3×1024).
    pub value: Vec<usize>,
    /// LSTM layers of the value function, after its hidden layers. An empty list makes it feed-forward (S: recurrent with
    /// the LSTM low level; its sizes are the low level's (D)).
    pub value_lstm: Vec<usize>,
    /// Width of the learned clip embedding, an input of the value function (S: 30).
    pub clip_embedding: usize,
    /// Outputs of the image encoder, in tasks with camera images (D).
    pub image_features: usize,
    /// The latent between encoder and low level.
    pub latent: Latent,
    /// The policy's standard deviation before learning (D: softplus of 0, ln 2).
    pub initial_std: f64,
    /// The policy's standard deviation at the budget's end (D). It is then not learned: it falls geometrically from
    /// `initial_std` with the budget, and is the same for every action, so `vmpo.epsilon_std` and `vmpo.entropy` have no
    /// effect. 0 is off: the standard deviation is learned (S).
    pub final_std: f64,
    /// Smallest standard deviation of the policy (D).
    pub min_std: f64,
    /// Scale of the policy head's initial weights, relative to the other layers' (D).
    pub policy_head_scale: f64,
    /// The policy's mean before learning (D).
    pub initial_pose: InitialPose,
    /// Steps whose mean and standard deviation normalise the observations: the first ones of the run. While they are collected,
    /// learner and actors get the newest mean and deviation with each published version. 0 is no normalisation (D).
    pub normaliser_steps: u64,
}

impl Default for Network {
    fn default() -> Self {
        Self {
            encoder: vec![1024, 1024],
            encoder_linear_path: true,
            low_level: LowLevelName::Mlp,
            mlp: Mlp::default(),
            lstm: Lstm::default(),
            primitives: Primitives::default(),
            value: vec![1024, 1024, 1024],
            value_lstm: Vec::new(),
            clip_embedding: 30,
            image_features: 64,
            latent: Latent::default(),
            initial_std: std::f64::consts::LN_2,
            final_std: 0.0,
            min_std: 1e-3,
            policy_head_scale: 1.0,
            initial_pose: InitialPose::MidRange,
            normaliser_steps: 0,
        }
    }
}

/// A low level.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LowLevelName {
    /// Feed-forward.
    Mlp,
    /// Recurrent.
    Lstm,
    /// A mixture of primitives.
    Mixture,
    /// A product of primitives.
    Product,
}

impl LowLevelName {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Mlp, Self::Lstm, Self::Mixture, Self::Product];

    /// As experiments and command lines write it. The paper's preset has the name `tracking-` with this at the end.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mlp => "mlp",
            Self::Lstm => "lstm",
            Self::Mixture => "mixture",
            Self::Product => "product",
        }
    }

    /// Whether it works without a latent: the encoder then gives the weights of the primitives.
    pub(crate) fn acts_without_bottleneck(self) -> bool {
        matches!(self, Self::Mixture | Self::Product)
    }
}

impl std::fmt::Display for LowLevelName {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(self.name())
    }
}

impl std::str::FromStr for LowLevelName {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|low_level| low_level.name() == name);
        found.ok_or_else(|| format!("no low level `{name}`; low levels are {}", Self::ALL.map(Self::name).join(", ")))
    }
}

/// The MLP low level.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Mlp {
    /// Hidden sizes (S: 2×1024).
    pub hidden: Vec<usize>,
}

impl Default for Mlp {
    fn default() -> Self {
        Self { hidden: vec![1024, 1024] }
    }
}

/// The LSTM low level.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Lstm {
    /// Units of the stacked layers (S: 384 and 256).
    pub units: Vec<usize>,
}

impl Default for Lstm {
    fn default() -> Self {
        Self { units: vec![384, 256] }
    }
}

/// Primitives: Gaussians that depend on proprioception alone. A gate computes their weights from the latent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Primitives {
    /// K (S: 5).
    pub count: usize,
    /// Hidden sizes of the torso, which all primitives share (S: 2×512).
    pub torso: Vec<usize>,
    /// Units of each primitive's own layer (S: 256).
    pub hidden: usize,
    /// Hidden sizes of the gate (S: 2×400). Not used without a bottleneck.
    pub gate: Vec<usize>,
    /// Adds a fixed bias to each primitive's mean. The biases are evenly spaced from −0.66 to 0.66 (S).
    pub biases: bool,
}

impl Default for Primitives {
    fn default() -> Self {
        Self { count: 5, torso: vec![512, 512], hidden: 256, gate: vec![400, 400], biases: false }
    }
}

impl Network {
    /// Gaussians in the action's distribution: K for a mixture, else 1.
    pub fn components(&self) -> usize {
        if self.low_level == LowLevelName::Mixture { self.primitives.count } else { 1 }
    }

    /// Size of the recurrent state: a hidden and a cell state for each unit of an LSTM, else 0.
    pub fn state_size(&self) -> usize {
        if self.low_level == LowLevelName::Lstm { 2 * self.lstm.units.iter().sum::<usize>() } else { 0 }
    }
}

/// The policy's mean before learning.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InitialPose {
    /// Action 0: the middle of every joint's range.
    MidRange,
    /// The action whose servos hold the mean pose of the reference clips.
    ReferenceMean,
}

/// The stochastic latent z.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Latent {
    /// Dimensions of z (S: 60). 0 is no bottleneck, for mixture and product: the encoder gives the weights directly.
    pub size: usize,
    /// β: weight of the KL divergence from the prior (S: 5e-4).
    pub beta: f64,
    /// Smallest standard deviation of the encoder (D).
    pub min_std: f64,
    /// The encoder's standard deviation before learning (D).
    pub initial_std: f64,
    /// The prior of z_t.
    pub prior: Prior,
}

impl Default for Latent {
    fn default() -> Self {
        Self { size: 60, beta: 5e-4, min_std: 1e-3, initial_std: std::f64::consts::LN_2, prior: Prior::Standard }
    }
}

/// The latent's prior.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Prior {
    /// N(0, I).
    Standard,
    /// p(z_t | s_t): a Gaussian that a network makes of proprioception, and that is learned in the KL divergence. The encoder
    /// then gives the difference from the prior's mean (PULSE; Luo et al., 2024). An exported low level has this prior.
    State {
        /// Hidden sizes of the prior's network.
        hidden: Vec<usize>,
    },
    /// N(α z_{t−1}, (1 − α²) I), N(0, I) at an episode's first step (NPMP: α = 0.95).
    Ar1 {
        /// α.
        alpha: f64,
    },
}
