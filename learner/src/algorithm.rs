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
//! # A second algorithm
//! It is a module beside `vmpo` with a learner that implements [`Algorithm`]. The loop does not change. The
//! one place that chooses is `State::new` in `train/state.rs`, which makes the `Box<dyn Algorithm>`. Losses are reported by
//! name, so they reach the metrics without another list.

pub mod error;
pub mod loss_report;
pub mod masked_mean;
pub mod minibatch;
pub mod shape;
pub(crate) mod stores;

use std::fmt::Debug;

use comic_networks::NormaliserStatistics;
use tch::Tensor;

use crate::algorithm::error::Error;
use crate::algorithm::loss_report::Losses;
use crate::algorithm::minibatch::MinibatchTensors;

/// Networks and their optimiser, changed one gradient step at a time.
pub trait Algorithm: Debug {
    /// One gradient step. It is skipped when the loss or a gradient is not finite: the report says so, and nothing
    /// changes.
    ///
    /// # Errors
    /// [`Error::Shape`] when the minibatch belongs to another task or network; nothing changes then.
    fn step(&mut self, minibatch: &MinibatchTensors) -> Result<Losses, Error>;

    /// One gradient step of the warm start: regression of the policy's mean towards the stored mean. Returns the report and
    /// the latents z_t, `[B, T, Z]`, for [`MinibatchTensors::refresh_previous_latent`]. It is skipped where
    /// [`step`](Self::step) would be.
    ///
    /// # Errors
    /// As of [`step`](Self::step).
    fn regress(&mut self, minibatch: &MinibatchTensors) -> Result<(Losses, Tensor), Error>;

    /// Batches from one published version of the parameters to the next.
    fn publish_period(&self) -> u64;

    /// Sets the statistics by which observations are normalised.
    ///
    /// # Errors
    /// [`Error::Networks`] when they do not fit the task.
    fn set_normaliser(&mut self, statistics: &NormaliserStatistics) -> Result<(), Error>;

    /// Sets everything that follows a schedule, when the share `used` of the budget is used, 0 to 1. The learning rate of
    /// the networks is part of it.
    fn set_progress(&mut self, used: f64);

    /// Sets the learning rate of the networks, until it is set again. Rates of other parameters are the algorithm's own.
    fn set_learning_rate(&mut self, rate: f64);

    /// Sets the optimiser's moments to zero, as between a warm start and training.
    fn reset_optimiser(&mut self);

    /// Whether every parameter is a finite number; waits for the device.
    fn is_finite(&self) -> bool;

    /// The parameters of the online policy as safetensors: what actors need.
    ///
    /// # Errors
    /// [`Error::Networks`] when they cannot be read from the device.
    fn policy_parameters(&self) -> Result<Vec<u8>, Error>;

    /// Everything that changes future steps, by name. The tensors are copies on the CPU, so another thread can write them
    /// while the next step runs.
    fn state(&self) -> Vec<(String, Tensor)>;

    /// Restores what [`state`](Self::state) gave.
    ///
    /// # Errors
    /// [`Error::State`] when names, shapes or element types differ; nothing changes then.
    fn load_state(&mut self, state: &[(String, Tensor)]) -> Result<(), Error>;
}
