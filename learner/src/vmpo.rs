//! V-MPO (Song et al., 2020) as CoMic uses it: pure loss functions, and the learner that steps them.
//!
//! # Layout
//! - [`mod@returns`]: n-step targets to the end of the unroll (or λ-returns).
//! - [`policy_improvement`]: L_π, L_η and L_α from log-probabilities, advantages and the two KLs.
//! - [`Multipliers`]: η, α_μ and α_Σ.
//! - `experience`: the newest batch, on-policy.
//! - [`VmpoLearner`]: networks, multipliers and Adam; one gradient step at a time.
//!
//! Everything is float32 and of static shape: masks instead of selections, so that a compiler of tensor programs
//! meets one shape only.

mod experience;
mod improvement;
mod learner;
mod multipliers;
mod report;
mod returns;

use std::sync::Arc;

use comic_proto::UnrollLayout;

use crate::algorithm::error::Error;
use crate::algorithm::experience::Experience;
use crate::algorithm::{self, Algorithm, Parts};
use crate::vmpo::experience::Newest;

pub use improvement::{Evidence, Improvement, KlLimits, policy_improvement};
pub use learner::VmpoLearner;
pub use multipliers::{MULTIPLIER_FLOOR, Multipliers};
pub use returns::returns;

/// Makes what V-MPO needs.
#[derive(Debug)]
pub(crate) struct Builder;

impl algorithm::Builder for Builder {
    fn learner(&self, parts: Parts<'_>) -> Result<Box<dyn Algorithm>, Error> {
        let learner = VmpoLearner::new(parts.spec, parts.experiment, parts.pose, parts.device)?;
        Ok(Box::new(learner.in_world(parts.world)))
    }

    fn experience(&self, parts: Parts<'_>, _: &Arc<UnrollLayout>) -> crate::error::Result<Box<dyn Experience>> {
        Ok(Box::new(Newest::new(parts.experiment, parts.spec.tasks.len(), parts.device)))
    }
}
