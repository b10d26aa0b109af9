//! The sections of an experiment, field by field.

use serde::{Deserialize, Serialize};

use crate::{BallCatch, DeviceName, Gaps, GetUp, GoToTarget, MatmulPrecision, Network, TaskName, Tracking, Walls};

/// A whole experiment, resolved: what is learnt, from which motion, how, and for how long.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Experiment {
    /// The experiment's name; a preset's own name unless overridden.
    pub name: String,
    /// Seed of everything random: networks, actors, minibatches.
    pub seed: u64,
    /// What is learnt; the section of the same name holds its numbers.
    pub task: TaskName,
    /// Tasks learnt beside it through the same low level: every episode draws its task (S: get-up 0.1 or ball 0.2).
    pub joint: Vec<Complement>,
    /// Motion capture, one entry per source: what is tracked, and the poses other tasks may start in.
    pub clips: Vec<ClipSource>,
    /// Motion-capture tracking.
    pub tracking: Tracking,
    /// Go-to-target.
    pub go_to_target: GoToTarget,
    /// The corridor with gaps.
    pub gaps: Gaps,
    /// The corridor with walls.
    pub walls: Walls,
    /// Get up and stand.
    pub get_up: GetUp,
    /// Ball catching.
    pub ball_catch: BallCatch,
    /// Sizes and initial values of the networks.
    pub network: Network,
    /// V-MPO's own numbers.
    pub vmpo: Vmpo,
    /// Adam.
    pub optimiser: Optimiser,
    /// How experience is cut up and put together again.
    pub unroll: Unroll,
    /// What one actor process does.
    pub actor: Actor,
    /// Regression towards the servo action before V-MPO starts.
    pub warm_start: WarmStart,
    /// The learner as a service.
    pub learner: Learner,
    /// When the run ends.
    pub budget: Budget,
}

/// A complementary task of joint training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Complement {
    /// The task; the section of its name holds its numbers.
    pub task: TaskName,
    /// Probability that an episode is one of this task's; the experiment's `task` has what is left.
    pub probability: f64,
}

impl Experiment {
    /// Every task and the probability that an episode is one of its own, `task` first.
    pub fn tasks(&self) -> Vec<(TaskName, f64)> {
        let others = self.joint.iter().map(|complement| (complement.task, complement.probability));
        let left = 1.0 - others.clone().map(|(_, probability)| probability).sum::<f64>();
        std::iter::once((self.task, left)).chain(others).collect()
    }
}

/// Where reference motion comes from: a built-in clip or a file in dm_control's HDF5 layout.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClipSource {
    /// `builtin:NAME`, or the path of an HDF5 file.
    pub source: String,
    /// One of dm_control's named subsets: `walk_tiny`, `run_jump_tiny`, `get_up`, `locomotion_small`, `all`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub subset: Option<String>,
    /// Clip names inside the file; every clip of the file (or subset) when empty.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ids: Vec<String>,
    /// First frame used, counted from the clip's start.
    #[serde(default)]
    pub start_step: usize,
    /// Last frame used, inclusive for the data and exclusive for starts, as in dm_control; the clip's end when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub end_step: Option<usize>,
    /// Weight of every start of these clips in the draw.
    #[serde(default = "one")]
    pub weight: f64,
}

fn one() -> f64 {
    1.0
}

impl ClipSource {
    /// The whole of one source, weight 1.
    pub fn whole(source: impl Into<String>) -> Self {
        Self { source: source.into(), subset: None, ids: Vec::new(), start_step: 0, end_step: None, weight: 1.0 }
    }

    /// The command line's form: `SOURCE`, or `SOURCE#SELECTION` where the selection is a named subset or clip names
    /// separated by commas: `builtin:walk`, `cmu.h5#walk_tiny`, `cmu.h5#CMU_007_01,CMU_002_03`.
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

/// V-MPO.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Vmpo {
    /// γ (S).
    pub discount: f64,
    /// ε_η: limit of the E-step (S).
    pub epsilon_eta: f64,
    /// ε_μ: limit on the mean (S).
    pub epsilon_mean: f64,
    /// ε_Σ: limit on the covariance (S: MLP and LSTM; 1e-3 for mixture and product).
    pub epsilon_std: f64,
    /// ε_discrete: limit on a mixture's weights (S).
    pub epsilon_discrete: f64,
    /// η at the start (S).
    pub initial_temperature: f64,
    /// α_μ at the start (S).
    pub initial_alpha_mean: f64,
    /// α_Σ at the start (S).
    pub initial_alpha_std: f64,
    /// α_discrete at the start (S).
    pub initial_alpha_discrete: f64,
    /// Share of the valid steps the E-step imitates (S: the top half).
    pub top_fraction: f64,
    /// In joint training the E-step's best steps and its temperature are each task's own, since the advantages of different
    /// tasks have different scales (D); off, one E-step ranks all steps.
    pub temperature_per_task: bool,
    /// The target network, with which actors act, is copied every so many learner steps (V).
    pub target_period: u64,
    /// Gradient steps on each batch (V: 1).
    pub gradient_steps: usize,
    /// Unrolls in a gradient step; must divide the batch (V: the whole batch).
    pub minibatch_unrolls: usize,
    /// λ of the return: 1 is the paper's n-step return, below it GAE's mixture (D).
    pub lambda: f64,
    /// Entropy bonus (V: none).
    pub entropy: f64,
    /// Weight of the value loss (D).
    pub value_weight: f64,
    /// The first so many rows of an unroll only wake a recurrent value function and are left out of every loss (D).
    pub value_burn_in: usize,
}

impl Default for Vmpo {
    fn default() -> Self {
        Self {
            discount: 0.95,
            epsilon_eta: 0.1,
            epsilon_mean: 0.1,
            epsilon_std: 1e-5,
            epsilon_discrete: 1e-3,
            initial_temperature: 1.0,
            initial_alpha_mean: 1.0,
            initial_alpha_std: 1.0,
            initial_alpha_discrete: 1.0,
            top_fraction: 0.5,
            temperature_per_task: true,
            target_period: 100,
            gradient_steps: 1,
            minibatch_unrolls: 128,
            lambda: 1.0,
            entropy: 0.0,
            value_weight: 1.0,
            value_burn_in: 0,
        }
    }
}

/// Adam.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Optimiser {
    /// Learning rate of every network (S).
    pub learning_rate: f64,
    /// Learning rate of the multipliers (S: the same).
    pub multiplier_learning_rate: f64,
    /// The learning rate falls linearly to this share of itself at the budget's end; 1 is constant (S).
    pub final_learning_rate_share: f64,
    /// β₁.
    pub beta1: f64,
    /// β₂.
    pub beta2: f64,
    /// ε.
    pub epsilon: f64,
    /// Global gradient norm is clipped to this; 0 is off (V).
    pub max_gradient_norm: f64,
}

impl Default for Optimiser {
    fn default() -> Self {
        Self {
            learning_rate: 1e-4,
            multiplier_learning_rate: 1e-4,
            final_learning_rate_share: 1.0,
            beta1: 0.9,
            beta2: 0.999,
            epsilon: 1e-8,
            max_gradient_norm: 0.0,
        }
    }
}

/// Unrolls and batches.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Unroll {
    /// T: transitions an unroll (S).
    pub length: usize,
    /// B: unrolls a batch (S).
    pub batch: usize,
    /// An unroll whose parameters are more than so many published versions old is refused as stale (D).
    pub max_staleness: u64,
    /// Batches assembled while one is trained on: 1 keeps the device busy (D), 0 keeps the experience fresh.
    pub ahead: usize,
    /// Lockstep, for debugging and tests: a batch is one unroll of each of `batch` environments, made with the newest
    /// parameters, so that the seed alone decides what is learnt, whatever actors share the environments. Slower; needs
    /// `ahead` 0 and no budget in minutes.
    pub lockstep: bool,
}

impl Default for Unroll {
    fn default() -> Self {
        Self { length: 32, batch: 128, max_staleness: 1000, ahead: 1, lockstep: false }
    }
}

/// One actor process.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Actor {
    /// Threads; each owns its environments and its copy of the policy.
    pub threads: usize,
    /// Environments a thread; one batched forward pass serves them all.
    pub environments: usize,
}

impl Default for Actor {
    fn default() -> Self {
        Self { threads: 1, environments: 16 }
    }
}

/// Regression towards the servo action of frame t + 1, on rollouts of that action with noise (D; the paper has none).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WarmStart {
    /// Gradient steps; 0 is no warm start.
    pub steps: u64,
    /// Environment steps of the servo gathered first, those of tasks without a reference among them.
    pub demonstration_steps: u64,
    /// Standard deviation of the noise added to the servo action.
    pub noise: f64,
    /// Unrolls in a regression step.
    pub minibatch_unrolls: usize,
    /// Adam's learning rate while regressing.
    pub learning_rate: f64,
}

impl Default for WarmStart {
    fn default() -> Self {
        Self { steps: 0, demonstration_steps: 32_768, noise: 0.1, minibatch_unrolls: 32, learning_rate: 1e-3 }
    }
}

/// The learner as a service.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Learner {
    /// Where the update runs.
    pub device: DeviceName,
    /// On XLA, how precisely matrices are multiplied; the losses are float32 everywhere.
    pub matmul_precision: MatmulPrecision,
    /// Threads of libtorch in the update.
    pub threads: usize,
    /// Seconds between checkpoints.
    pub checkpoint_seconds: f64,
    /// Checkpoints kept.
    pub checkpoints_kept: usize,
    /// Seconds between metric lines.
    pub metrics_seconds: f64,
    /// So many gradient steps in a row that were skipped, since a loss or gradient was not finite, lead back to the last
    /// good state (D).
    pub restore_after: u64,
}

impl Default for Learner {
    fn default() -> Self {
        Self {
            device: DeviceName::Cpu,
            matmul_precision: MatmulPrecision::Highest,
            threads: 1,
            checkpoint_seconds: 60.0,
            checkpoints_kept: 3,
            metrics_seconds: 5.0,
            restore_after: 10,
        }
    }
}

/// When the run ends; whatever comes first. Zero is no limit.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Budget {
    /// Minutes of wall-clock time since the first unroll, earlier lives of the learner included.
    pub minutes: f64,
    /// Environment steps trained on, over the run's whole life.
    pub environment_steps: u64,
    /// Batches trained on, over the run's whole life.
    pub updates: u64,
}

impl Default for Experiment {
    fn default() -> Self {
        Self {
            name: "tracking-mlp".into(),
            seed: 1,
            task: TaskName::Tracking,
            joint: Vec::new(),
            clips: vec![ClipSource::whole("builtin:CMU_007_01")],
            tracking: Tracking::default(),
            go_to_target: GoToTarget::default(),
            gaps: Gaps::default(),
            walls: Walls::default(),
            get_up: GetUp::default(),
            ball_catch: BallCatch::default(),
            network: Network::default(),
            vmpo: Vmpo::default(),
            optimiser: Optimiser::default(),
            unroll: Unroll::default(),
            actor: Actor::default(),
            warm_start: WarmStart::default(),
            learner: Learner::default(),
            budget: Budget::default(),
        }
    }
}
