//! The learner of whichever algorithm an experiment names.

use std::sync::Arc;

use comic_experiment::{AlgorithmName, for_each_algorithm};
use comic_proto::UnrollLayout;

use crate::algorithm::experience::Experience;
use crate::algorithm::{Algorithm, Builder, Parts, error};
use crate::error::Result;

macro_rules! builders {
    ($($(#[$description:meta])* $algorithm:ident, $module:ident;)*) => {
        fn builder(algorithm: AlgorithmName) -> &'static dyn Builder {
            match algorithm {
                $(AlgorithmName::$algorithm => &crate::$module::Builder,)*
            }
        }
    };
}

for_each_algorithm!(builders);

/// New networks of the experiment's algorithm, with their optimiser.
///
/// # Errors
/// When the networks cannot be made.
pub fn learner(parts: Parts<'_>) -> std::result::Result<Box<dyn Algorithm>, error::Error> {
    builder(parts.experiment.algorithm).learner(parts)
}

/// What the gradient steps of the experiment's algorithm learn from. Unrolls have this layout.
///
/// # Errors
/// When memory cannot hold it.
pub fn experience(parts: Parts<'_>, layout: &Arc<UnrollLayout>) -> Result<Box<dyn Experience>> {
    builder(parts.experiment.algorithm).experience(parts, layout)
}
