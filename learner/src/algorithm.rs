//! What the training loop needs from a learning algorithm: the seam between the two.
//!
//! The loop (`train/trainer.rs`) turns batches into minibatches, calls [`Algorithm::step`], and
//! publishes, reports and saves what the algorithm gives it. It does not know which algorithm runs.
//!
//! # Layout
//! - [`minibatch`]: unrolls as tensors, batch first, with the numbers of rows without a transition blanked. [`shape`] is
//!   their sizes.
//! - [`loss_report`]: what a gradient step reports, by name, read from the device once.
//! - [`mod@masked_mean`]: the mean over rows with a transition. `stores` names the parameters of networks.
//! - [`error`]: what an algorithm refuses.
//!
//! - [`experience`]: where the unrolls of gradient steps come from: the newest batch, or a [`replay`].
//! - `descent`: gradients, their norms, and a step of Adam that is taken as a whole or not at all.
//!
//! # A third algorithm
//! It is an entry of the list `for_each_algorithm!`, a section of the document, and a file in each of three crates: its
//! parameters in `experiment/src/algorithms/`, its policy in `networks/src/`, and its learner in a folder of this crate. In each
//! crate a `Builder` of that name makes it. Losses are reported by name, so they reach the metrics without another list.

pub(crate) mod descent;
pub mod error;
pub mod experience;
pub mod loss_report;
pub mod masked_mean;
pub mod minibatch;
pub mod replay;
pub mod shape;
pub(crate) mod stores;

use std::fmt::Debug;
use std::sync::Arc;

use comic_experiment::{Experiment, TaskSpec};
use comic_networks::NormaliserStatistics;
use comic_proto::UnrollLayout;
use tch::{Device, Tensor};

use crate::algorithm::error::Error;
use crate::algorithm::experience::Experience;
use crate::algorithm::loss_report::Losses;
use crate::algorithm::minibatch::MinibatchTensors;
use crate::world::World;

/// Networks and their optimiser, changed one gradient step at a time.
pub trait Algorithm: Debug {
    /// One gradient step. It is skipped when the loss or a gradient is not finite: the report says so, and nothing
    /// changes.
    ///
    /// # Errors
    /// [`Error::Shape`] when the minibatch belongs to another task or network; nothing changes then.
    fn step(&mut self, minibatch: &MinibatchTensors) -> Result<Losses, Error>;

    /// Whether a new version of the parameters is due after update number `updates`, which took `steps` gradient steps.
    fn publishes_after(&self, updates: u64, steps: u64) -> bool;

    /// Sets the statistics by which observations are normalised.
    ///
    /// # Errors
    /// [`Error::Networks`] when they do not fit the task.
    fn set_normaliser(&mut self, statistics: &NormaliserStatistics) -> Result<(), Error>;

    /// Sets everything that follows a schedule, when the share `used` of the budget is used, 0 to 1. The learning rate of
    /// the networks is part of it.
    fn set_progress(&mut self, used: f64);

    /// Whether every parameter is a finite number; waits for the device.
    fn is_finite(&self) -> bool;

    /// The parameters of the online policy as safetensors: what actors need.
    ///
    /// # Errors
    /// [`Error::Networks`] when they cannot be read from the device.
    fn policy_parameters(&self) -> Result<Vec<u8>, Error>;

    /// Every trained parameter's name and number of elements.
    fn parameter_counts(&self) -> Vec<(String, usize)>;

    /// What usually helps when losses and gradients are not finite again and again.
    fn remedies(&self) -> &'static str;

    /// Everything that changes future steps, by name. The tensors are copies on the CPU, so another thread can write them
    /// while the next step runs.
    fn state(&self) -> Vec<(String, Tensor)>;

    /// Restores what [`state`](Self::state) gave.
    ///
    /// # Errors
    /// [`Error::State`] when names, shapes or element types differ; nothing changes then.
    fn load_state(&mut self, state: &[(String, Tensor)]) -> Result<(), Error>;
}

/// What a learner is made from.
#[derive(Clone, Copy, Debug)]
pub struct Parts<'a> {
    /// The resolved experiment.
    pub experiment: &'a Experiment,
    /// The task's sizes and names.
    pub spec: &'a TaskSpec,
    /// The action at which the policy's mean starts, `[A]`.
    pub pose: &'a [f32],
    /// Where it computes.
    pub device: Device,
    /// The ranks that train together. The experiment is that of this rank's share.
    pub world: &'a World,
}

/// What an algorithm brings: its networks with their optimiser, and where its experience comes from.
pub(crate) trait Builder {
    /// New networks and their optimiser.
    ///
    /// # Errors
    /// [`Error::Networks`] when the networks cannot be made.
    fn learner(&self, parts: Parts<'_>) -> Result<Box<dyn Algorithm>, Error>;

    /// What its gradient steps learn from. Unrolls have this layout.
    ///
    /// # Errors
    /// [`crate::error::Error::Configuration`] when memory cannot hold it.
    fn experience(&self, parts: Parts<'_>, layout: &Arc<UnrollLayout>) -> crate::error::Result<Box<dyn Experience>>;
}

/// The learner that `make` makes, on `device`. First values come from libtorch's generator on the CPU, so after
/// `tch::manual_seed` they are the same on every device.
///
/// # Errors
/// Those of `make`.
pub(crate) fn made_on<L: Algorithm>(device: Device, make: impl Fn(Device) -> Result<L, Error>) -> Result<L, Error> {
    let host = make(Device::Cpu)?;
    if device == Device::Cpu {
        return Ok(host);
    }
    let mut learner = make(device)?;
    learner.load_state(&host.state())?;
    Ok(learner)
}
