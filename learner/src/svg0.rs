//! SVG(0) (Heess et al., 2015) with Retrace (Munos et al., 2016), as CoMic's transfer experiments use it: off-policy, with an action
//! value, a recurrent core that action value and policy share, and target networks.
//!
//! # Layout
//! - [`mod@retrace`]: the targets of the action value.
//! - [`mod@losses`]: the losses, a pure function of [`Networks`], minibatch and noise.
//! - [`Svg0Learner`]: online and target networks and Adam; one gradient step at a time.
//!
//! Everything is float32 and of static shape: masks instead of selections.

mod learner;
mod losses;
mod retrace;

use std::sync::Arc;

use comic_proto::UnrollLayout;

use crate::algorithm::error::Error;
use crate::algorithm::experience::Experience;
use crate::algorithm::replay::Replay;
use crate::algorithm::{self, Algorithm, Parts};

pub use learner::Svg0Learner;
pub use losses::{Networks, Terms, losses, noise};
pub use retrace::{Trace, retrace};

/// Makes what SVG(0) needs.
#[derive(Debug)]
pub(crate) struct Builder;

impl algorithm::Builder for Builder {
    fn learner(&self, parts: Parts<'_>) -> Result<Box<dyn Algorithm>, Error> {
        Ok(Box::new(Svg0Learner::new(parts.spec, parts.experiment, parts.device)?))
    }

    fn experience(&self, parts: Parts<'_>, layout: &Arc<UnrollLayout>) -> crate::error::Result<Box<dyn Experience>> {
        let Parts { experiment, spec, device, .. } = parts;
        let (minibatch, period) = (experiment.svg0.minibatch_sequences, experiment.svg0.publish_period);
        Ok(Box::new(Replay::new(experiment, layout, spec.tasks.len(), minibatch, period, device)?))
    }
}
