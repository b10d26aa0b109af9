//! The learning algorithms. `for_each_algorithm` is the list of them; each has a file of its own with its parameters.

mod svg0;
mod vmpo;

use serde::{Deserialize, Serialize};

use crate::document::Experiment;
use crate::fault::{Fault, ensure};

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

        impl Experiment {
            /// The section of its algorithm.
            fn algorithm_parameters(&self) -> &dyn AlgorithmParameters {
                match self.algorithm {
                    $(AlgorithmName::$algorithm => &self.$section,)*
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

/// What an algorithm's section tells about the algorithm.
trait AlgorithmParameters {
    /// # Errors
    /// The first field with a value that is meaningless, or is so beside other fields of the experiment.
    fn check(&self, experiment: &Experiment) -> Result<(), Fault>;

    /// Fields and sections that the algorithm does not read, by dotted name. The sections of other algorithms are among
    /// them anyway.
    fn unread(&self, experiment: &Experiment) -> Vec<&'static str>;

    /// Whether its policy has a reference encoder and a low level, unless a frozen low level acts.
    fn has_low_level(&self) -> bool;

    /// Size of the policy's recurrent state. A frozen low level's state is not part of it.
    fn state_size(&self, experiment: &Experiment) -> usize;

    /// Whether it learns from the simulator's derivative of the rewards with respect to the actions.
    fn reads_action_gradient(&self) -> bool {
        false
    }
}

/// Fields that mean nothing to the experiment's algorithm, and faults of its own section.
pub(crate) fn check(experiment: &Experiment) -> Result<(), Fault> {
    let unread = experiment.unread();
    // TOML can write every document whose numbers were checked.
    let changed = experiment.differences(&Experiment::default()).unwrap_or_default();
    if let Some(set) = changed.into_iter().find(|set| unread.iter().any(|name| is_within(&set.field, name))) {
        let remedy = format!("algorithm = \"{}\" does not read it; leave it at {}", experiment.algorithm, set.theirs);
        return Err(Fault { field: set.field, value: set.ours, remedy });
    }
    experiment.algorithm_parameters().check(experiment)
}

/// Whether `field` is `outer`, or a field of the section `outer`.
fn is_within(field: &str, outer: &str) -> bool {
    field.strip_prefix(outer).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
}

impl Experiment {
    /// Fields and sections that the experiment's algorithm does not read, by dotted name.
    pub(crate) fn unread(&self) -> Vec<&'static str> {
        let others = AlgorithmName::ALL.into_iter().filter(|name| *name != self.algorithm);
        others.map(AlgorithmName::name).chain(self.algorithm_parameters().unread(self)).collect()
    }

    /// Whether the policy has an encoder and a low level of its own, which it learns.
    pub fn learns_low_level(&self) -> bool {
        !self.transfer.is_on() && self.algorithm_parameters().has_low_level()
    }

    /// Size of the policy's recurrent state. A frozen low level's state is not part of it.
    pub fn state_size(&self) -> usize {
        self.algorithm_parameters().state_size(self)
    }

    /// Whether actors compute the simulator's derivative of the rewards with respect to the actions.
    pub fn reads_action_gradient(&self) -> bool {
        self.algorithm_parameters().reads_action_gradient()
    }
}

/// Hidden sizes of one or more layers.
fn layers(field: &str, sizes: &[usize]) -> Result<(), Fault> {
    let holds = !sizes.is_empty() && sizes.iter().all(|size| (1..=16384).contains(size)) && sizes.len() <= 64;
    ensure(field, sizes, holds, "must be one or more layers of 1 to 16384 units")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_document_writes_an_algorithm_by_the_name_of_its_section() {
        let document = Experiment::default().to_table().unwrap();
        for algorithm in AlgorithmName::ALL {
            assert_eq!(toml::Value::try_from(algorithm).unwrap().as_str(), Some(algorithm.name()));
            assert!(document[algorithm.name()].is_table());
        }
    }

    #[test]
    fn every_name_of_an_unread_field_is_one() {
        let document = toml::Value::Table(Experiment::default().to_table().unwrap());
        for algorithm in AlgorithmName::ALL {
            let experiment = Experiment { algorithm, ..Experiment::default() };
            for name in experiment.unread() {
                let found = name.split('.').try_fold(&document, |place, part| place.get(part));
                assert!(found.is_some(), "{algorithm}: {name}");
            }
        }
    }
}
