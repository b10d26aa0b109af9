//! The sections of the optimiser, experience, actors, the learner and the budget.

use serde::{Deserialize, Serialize};

use crate::device::{DeviceName, MatmulPrecision, PublishedNumber};

/// The longest unroll.
pub const LONGEST_UNROLL: usize = 4096;

/// The largest entry of the simulator's derivative that an actor sends and a learner takes (D). Usual entries are below 1. A
/// larger one comes from a simulation that is about to diverge, and would outweigh its whole minibatch.
pub const LARGEST_ACTION_GRADIENT: f32 = 1e3;

/// Adam.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Optimiser {
    /// Learning rate of every network, whichever algorithm trains it (S; A for SVG(0): the same).
    pub learning_rate: f64,
    /// Learning rate of the multipliers (S: the same).
    pub multiplier_learning_rate: f64,
    /// Share of the learning rate that is left at the budget's end. It falls linearly; 1 keeps it constant (S).
    pub final_learning_rate_share: f64,
    /// β₁.
    pub beta1: f64,
    /// β₂.
    pub beta2: f64,
    /// ε.
    pub epsilon: f64,
    /// Limit of the global gradient norm. Larger gradients are scaled down; 0 is no limit (V).
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
    /// T: transitions in an unroll (S).
    pub length: usize,
    /// B: unrolls in a batch (S).
    pub batch: usize,
    /// Most updates since newer parameters than an unroll's were published. An older unroll is dropped as stale. Counted in
    /// whole versions, rounded up: V-MPO publishes one every `vmpo.target_period` updates. 400 are four versions of the paper's;
    /// with 4000 actors, 99 % of the versions were at most three late (D; docs/capacity.md). SVG(0) learns from a replay and has no
    /// limit.
    pub max_staleness: u64,
    /// Batches that are assembled while the learner trains on one: 1 keeps the device busy (D), 0 keeps the experience new.
    pub ahead: usize,
    /// Lockstep, for debugging and tests. A batch has one unroll of each of `batch` environments, made with the newest
    /// parameters. The seed alone decides all learned parameters, for any number of actors. Lockstep is slower. It needs
    /// `ahead` 0 and no budget in minutes.
    pub lockstep: bool,
}

impl Default for Unroll {
    fn default() -> Self {
        Self { length: 32, batch: 128, max_staleness: 400, ahead: 1, lockstep: false }
    }
}

/// One actor process.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Actor {
    /// Threads. Each has its own environments and its own copy of the policy.
    pub threads: usize,
    /// Environments in a thread. One batched forward pass computes all their actions.
    pub environments: usize,
}

impl Default for Actor {
    fn default() -> Self {
        Self { threads: 1, environments: 16 }
    }
}

/// The learner as a service.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Learner {
    /// The device on which the update runs.
    pub device: DeviceName,
    /// How precisely XLA multiplies matrices. The losses are float32 on every device.
    pub matmul_precision: MatmulPrecision,
    /// Threads of libtorch in the update.
    pub threads: usize,
    /// The numbers of published parameters: bfloat16 halves what the network carries to the actors (D).
    pub published_number: PublishedNumber,
    /// Seconds between checkpoints.
    pub checkpoint_seconds: f64,
    /// Checkpoints kept.
    pub checkpoints_kept: usize,
    /// Seconds between metric lines.
    pub metrics_seconds: f64,
    /// A gradient step with a loss or gradient that is not finite is skipped. After this many skipped steps in a row, the
    /// learner restores its last good state (D).
    pub restore_after: u64,
}

impl Default for Learner {
    fn default() -> Self {
        Self {
            device: DeviceName::Cpu,
            matmul_precision: MatmulPrecision::Highest,
            threads: 1,
            published_number: PublishedNumber::Float32,
            checkpoint_seconds: 60.0,
            checkpoints_kept: 3,
            metrics_seconds: 5.0,
            restore_after: 10,
        }
    }
}

/// When the run ends: at the first limit that is reached. 0 is no limit.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Budget {
    /// Minutes since the first unroll. Time before a restart of the learner counts, too.
    pub minutes: f64,
    /// Environment steps of the batches that were trained on, in the whole run.
    pub environment_steps: u64,
    /// Batches that were trained on, in the whole run. With a replay and without lockstep a batch is what had arrived, from one
    /// unroll on, so this limit depends on the machine.
    pub updates: u64,
}
