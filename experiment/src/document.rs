//! The whole document.

use serde::{Deserialize, Serialize};

use crate::algorithms::{AlgorithmName, AlgorithmParameters, Rest, Svg0, Vmpo};
use crate::body::ACTION_SIZE;
use crate::clips::ClipSource;
use crate::error::Error;
use crate::fault::{Fault, ensure};
use crate::network::Network;
use crate::replay::Replay;
use crate::settings::{Actor, Budget, Learner, Optimiser, Unroll};
use crate::tasks::{self, TaskName, TaskParameters};
use crate::transfer::Transfer;
use crate::{for_each_algorithm, for_each_task};

macro_rules! document {
    ($($(#[$description:meta])* $task:ident, $section:ident, $name:literal;)*) => {
        /// A whole, resolved experiment: what is learnt, from which clips, how, and for how long.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct Experiment {
            /// The experiment's name. A preset has its own name here.
            pub name: String,
            /// Seed of all random numbers: networks, actors, minibatches.
            pub seed: u64,
            /// The learning algorithm. The section of the same name holds its parameters.
            pub algorithm: AlgorithmName,
            /// The task. The section of the same name holds its parameters.
            pub task: TaskName,
            /// Tasks of joint training: each episode draws its task, and all tasks share the low level (S: get-up 0.1 or
            /// ball 0.2).
            pub joint: Vec<Complement>,
            /// Motion capture, one entry per source: the references of tracking, and the start poses of other tasks.
            pub clips: Vec<ClipSource>,
            $($(#[$description])* pub $section: tasks::$task,)*
            /// A low level that was learned before, which acts frozen.
            pub transfer: Transfer,
            /// Sizes and initial values of the networks.
            pub network: Network,
            /// Parameters of V-MPO.
            pub vmpo: Vmpo,
            /// Parameters of SVG(0).
            pub svg0: Svg0,
            /// The replay of an off-policy algorithm.
            pub replay: Replay,
            /// Adam.
            pub optimiser: Optimiser,
            /// Unrolls and batches.
            pub unroll: Unroll,
            /// One actor process.
            pub actor: Actor,
            /// The learner as a service.
            pub learner: Learner,
            /// When the run ends.
            pub budget: Budget,
        }

        impl Default for Experiment {
            fn default() -> Self {
                Self {
                    name: "tracking-mlp".into(),
                    seed: 1,
                    algorithm: AlgorithmName::default(),
                    task: TaskName::Tracking,
                    joint: Vec::new(),
                    clips: vec![ClipSource::whole("builtin:CMU_007_01")],
                    $($section: tasks::$task::default(),)*
                    transfer: Transfer::default(),
                    network: Network::default(),
                    vmpo: Vmpo::default(),
                    svg0: Svg0::default(),
                    replay: Replay::default(),
                    optimiser: Optimiser::default(),
                    unroll: Unroll::default(),
                    actor: Actor::default(),
                    learner: Learner::default(),
                    budget: Budget::default(),
                }
            }
        }

        impl Experiment {
            /// The section of a task.
            pub(crate) fn parameters(&self, task: TaskName) -> &dyn TaskParameters {
                match task {
                    $(TaskName::$task => &self.$section,)*
                }
            }
        }
    };
}

for_each_task!(document);

macro_rules! parameters {
    ($($(#[$description:meta])* $algorithm:ident, $section:ident;)*) => {
        impl Experiment {
            /// The section of its algorithm.
            pub(crate) fn algorithm_parameters(&self) -> &dyn AlgorithmParameters {
                match self.algorithm {
                    $(AlgorithmName::$algorithm => &self.$section,)*
                }
            }

            fn algorithm_parameters_mut(&mut self) -> &mut dyn AlgorithmParameters {
                match self.algorithm {
                    $(AlgorithmName::$algorithm => &mut self.$section,)*
                }
            }
        }
    };
}

for_each_algorithm!(parameters);

/// A complementary task of joint training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Complement {
    /// The task. The section of the same name holds its parameters.
    pub task: TaskName,
    /// Probability that an episode is one of this task. The experiment's `task` has the remaining probability.
    pub probability: f64,
}

impl Experiment {
    /// The share of each of so many learners that train this experiment together: a part of every batch and minibatch.
    ///
    /// # Errors
    /// [`Error::Value`] with the field that they cannot share.
    pub fn share(&self, ranks: usize) -> Result<Self, Error> {
        let mut share = self.clone();
        share.divide(ranks).map_err(|Fault { field, value, remedy }| {
            let origin = format!("{ranks} learners together");
            Error::Value { origin, field, value, remedy }
        })?;
        Ok(share)
    }

    fn divide(&mut self, ranks: usize) -> Result<(), Fault> {
        if ranks == 1 {
            return Ok(());
        }
        let batch = self.unroll.batch;
        let holds = ranks > 0 && batch.is_multiple_of(ranks);
        ensure("unroll.batch", batch, holds, format!("must be a multiple of {ranks}"))?;
        let lockstep = self.unroll.lockstep;
        ensure("unroll.lockstep", lockstep, !lockstep, "must be false: arrival decides which unrolls share a batch")?;
        self.unroll.batch /= ranks;
        self.algorithm_parameters_mut().share(ranks)
    }

    /// Every task and the probability of an episode of it, `task` first.
    pub fn tasks(&self) -> Vec<(TaskName, f64)> {
        let others = self.joint.iter().map(|complement| (complement.task, complement.probability));
        let left = 1.0 - others.clone().map(|(_, probability)| probability).sum::<f64>();
        std::iter::once((self.task, left)).chain(others).collect()
    }

    /// Length of the policy's action: the actuators, or the latent of a frozen low level.
    pub fn action_size(&self) -> usize {
        if self.transfer.is_on() { self.network.latent.size } else { ACTION_SIZE }
    }

    /// What the algorithm may need to know of the other sections.
    pub(crate) fn rest(&self) -> Rest<'_> {
        Rest {
            tasks: self.tasks().into_iter().map(|(task, _)| task).collect(),
            transfers: self.transfer.is_on(),
            tracking: &self.tracking,
            network: &self.network,
            replay: &self.replay,
            unroll: &self.unroll,
        }
    }

    /// Fields and sections that the algorithm does not read, by dotted name.
    pub(crate) fn unread(&self) -> Vec<&'static str> {
        let others = AlgorithmName::ALL.into_iter().filter(|name| *name != self.algorithm);
        others.map(AlgorithmName::name).chain(self.algorithm_parameters().unread(&self.rest())).collect()
    }

    /// Whether the policy has an encoder and a low level of its own, which it learns.
    pub fn learns_low_level(&self) -> bool {
        !self.transfer.is_on() && self.algorithm_parameters().has_low_level()
    }

    /// Whether actors compute the simulator's derivative of the rewards with respect to the actions.
    pub fn reads_action_gradient(&self) -> bool {
        self.algorithm_parameters().reads_action_gradient()
    }

    /// Most published versions by which an unroll may be late: `unroll.max_staleness` in versions, and none in lockstep.
    pub fn max_versions_late(&self) -> u64 {
        match self.unroll.lockstep {
            true => 0,
            false => self.algorithm_parameters().versions_in(self.unroll.max_staleness).unwrap_or(u64::MAX),
        }
    }

    /// Length of the latent that the policy samples itself.
    pub fn latent_size(&self) -> usize {
        if self.learns_low_level() { self.network.latent.size } else { 0 }
    }

    /// Gaussians in the distribution of the policy's action.
    pub fn components(&self) -> usize {
        if self.learns_low_level() { self.network.components() } else { 1 }
    }

    /// Size of the policy's recurrent state. A frozen low level's state is not part of it.
    pub fn state_size(&self) -> usize {
        self.algorithm_parameters().state_size(&self.rest())
    }

    /// Size of the recurrent state of a frozen low level; 0 without one.
    pub fn frozen_state_size(&self) -> usize {
        if self.transfer.is_on() { self.network.state_size() } else { 0 }
    }
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
