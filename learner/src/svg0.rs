//! SVG(0) (Heess et al., 2015) with Retrace (Munos et al., 2016), as CoMic's transfer experiments use it: off-policy, with an action
//! value, a recurrent core that action value and policy share, and target networks.
//!
//! # Layout
//! - [`mod@retrace`]: the targets of the action value.
//! - [`Svg0Learner`]: online and target networks and Adam; one gradient step at a time.
//!
//! Everything is float32 and of static shape: masks instead of selections.

mod learner;
mod retrace;

pub use learner::Svg0Learner;
pub use retrace::{Trace, retrace};
