//! V-MPO (Song et al., 2020) as CoMic uses it: pure loss functions, and the learner that steps them.
//!
//! # Layout
//! - [`mod@returns`]: n-step targets to the end of the unroll (or λ-returns).
//! - [`policy_improvement`]: L_π, L_η and L_α from log-probabilities, advantages and the two KLs.
//! - [`Multipliers`]: η, α_μ and α_Σ.
//! - [`VmpoLearner`]: networks, multipliers and Adam; one gradient step at a time.
//!
//! Everything is float32 and of static shape: masks instead of selections, so that a compiler of tensor programs
//! meets one shape only.

mod improvement;
mod learner;
mod multipliers;
mod report;
mod returns;

pub use improvement::{Evidence, Improvement, KlLimits, policy_improvement};
pub use learner::VmpoLearner;
pub use multipliers::{MULTIPLIER_FLOOR, Multipliers};
pub use returns::returns;
