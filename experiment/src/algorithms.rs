//! The learning algorithms. `for_each_algorithm` is the list of them; each has a file of its own with its parameters.

mod svg0;
mod vmpo;

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, ensure};
use crate::network::Network;
use crate::replay::Replay;
use crate::settings::Unroll;
use crate::tasks::{TaskName, Tracking};

pub use svg0::Svg0;
pub use vmpo::Vmpo;

/// Calls the macro `$then` with the list of all algorithms, in the order of the document.
///
/// An entry has the algorithm's description, the type of its parameters (also its variant of [`AlgorithmName`]), and its
/// section of the document, which is also its name on command lines, and that of its module in every crate.
#[macro_export]
macro_rules! for_each_algorithm {
    ($then:ident) => {
        $then! {
            /// V-MPO, on-policy.
            Vmpo, vmpo;
            /// SVG(0) with Retrace, off-policy from a replay.
            Svg0, svg0;
        }
    };
}

macro_rules! algorithm_names {
    ($($(#[$description:meta])* $algorithm:ident, $section:ident;)*) => {
        /// A learning algorithm. The section of the same name holds its parameters.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(rename_all = "kebab-case")]
        pub enum AlgorithmName {
            $($(#[$description])* $algorithm,)*
        }

        impl AlgorithmName {
            /// All of them, in the order of the document.
            pub const ALL: [Self; [$(stringify!($section)),*].len()] = [$(Self::$algorithm),*];

            /// As experiments and command lines write it.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$algorithm => stringify!($section),)*
                }
            }
        }
    };
}

for_each_algorithm!(algorithm_names);

/// The paper's tracking experiments.
impl Default for AlgorithmName {
    fn default() -> Self {
        Self::Vmpo
    }
}

impl std::fmt::Display for AlgorithmName {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(self.name())
    }
}

/// What an algorithm may need to know of the rest of the document.
pub(crate) struct Rest<'a> {
    /// Every task.
    pub(crate) tasks: Vec<TaskName>,
    /// Whether a frozen low level acts.
    pub(crate) transfers: bool,
    pub(crate) tracking: &'a Tracking,
    pub(crate) network: &'a Network,
    pub(crate) replay: &'a Replay,
    pub(crate) unroll: &'a Unroll,
}

/// What an algorithm's section tells about the algorithm.
pub(crate) trait AlgorithmParameters {
    /// # Errors
    /// The first field with a value that is meaningless, or is so beside the rest of the document.
    fn check(&self, rest: &Rest<'_>) -> Result<(), Fault>;

    /// Fields and sections that the algorithm does not read, by dotted name. The sections of other algorithms are among
    /// them anyway.
    fn unread(&self, rest: &Rest<'_>) -> Vec<&'static str>;

    /// Whether its policy has a reference encoder and a low level, unless a frozen low level acts.
    fn has_low_level(&self) -> bool;

    /// Size of the policy's recurrent state. A frozen low level's state is not part of it.
    fn state_size(&self, rest: &Rest<'_>) -> usize;

    /// How many published versions take so many updates, rounded up: the most by which an unroll may be late. `None` if
    /// unrolls of every age are learned from.
    fn versions_in(&self, updates: u64) -> Option<u64>;

    /// Reduces the section to the share of one of so many learners.
    ///
    /// # Errors
    /// The field that they cannot share, or that several learners do not support.
    fn share(&mut self, ranks: usize) -> Result<(), Fault>;

    /// Whether it learns from the simulator's derivative of the rewards with respect to the actions.
    fn reads_action_gradient(&self) -> bool {
        false
    }
}

/// Hidden sizes of one or more layers.
fn layers(field: &str, sizes: &[usize]) -> Result<(), Fault> {
    let holds = !sizes.is_empty() && sizes.iter().all(|size| (1..=16384).contains(size)) && sizes.len() <= 64;
    ensure(field, sizes, holds, "must be one or more layers of 1 to 16384 units")
}
