//! V-MPO (Song et al., 2020) as CoMic uses it: pure loss functions, and the learner that steps them.
//!
//! # Layout
//! - [`MinibatchTensors`]: unrolls as tensors, batch first; rows that are no transition are blanked on the way in.
//! - [`returns`]: n-step targets to the end of the unroll (or λ-returns).
//! - [`policy_improvement`]: L_π, L_η and L_α from log-probabilities, advantages and the two KLs.
//! - [`Multipliers`]: η, α_μ and α_Σ.
//! - [`VmpoLearner`]: networks, multipliers and Adam; one gradient step at a time.
//! - [`Losses`] and [`LossValues`]: what a step reports, read from the device once.
//!
//! Everything is float32 and of static shape: masks instead of selections, so that a compiler of tensor programs
//! meets one shape only.

mod error;
mod improvement;
mod learner;
mod losses;
mod minibatch;
mod multipliers;
mod returns;
mod stores;

pub use error::Error;
pub use improvement::{Evidence, Improvement, KlLimits, masked_mean, policy_improvement};
pub use learner::VmpoLearner;
pub use losses::{LossValues, Losses};
pub use minibatch::{MinibatchShape, MinibatchSource, MinibatchTensors};
pub use multipliers::{MULTIPLIER_FLOOR, Multipliers};
pub use returns::returns;
