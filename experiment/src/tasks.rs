//! The tasks. `for_each_task` is the list of them; each has a file of its own with its parameters.
//!
//! (S) is the CoMic supplement, (C) dm_control's published task code where the supplement is silent, (D) a decision of
//! this project. Where dm_control's own default differs from the supplement, the field's comment names it.

mod ball_catch;
mod corridor;
mod gaps;
mod get_up;
mod go_to_target;
mod shared;
mod tracking;
mod walls;

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Section};

pub use ball_catch::BallCatch;
pub use corridor::Corridor;
pub use gaps::Gaps;
pub use get_up::{GetUp, GradientOfStanding, LyingPose};
pub use go_to_target::GoToTarget;
pub use shared::{GradientOfSpeed, StartPose, Vision};
pub use tracking::{
    GradientOfReward, TRACKING_MAX_REWARD, TRACKING_OBSERVATIONS, TRACKING_REWARD_TERMS, TRACKING_TERM_LIMITS,
    TerminationError, Tracking, tracking_observation_size,
};
pub use walls::{WallSide, Walls};

/// Calls the macro `$then` with the list of all tasks, in the order of the document.
///
/// An entry has the task's description, the type of its parameters (also its variant of [`TaskName`]), its section of
/// the document, and its name on command lines.
#[macro_export]
macro_rules! for_each_task {
    ($then:ident) => {
        $then! {
            /// Multi-clip motion-capture tracking.
            Tracking, tracking, "tracking";
            /// Walk to targets.
            GoToTarget, go_to_target, "go-to-target";
            /// Run through a corridor with gaps, guided by camera images.
            Gaps, gaps, "gaps";
            /// Run through a corridor with walls, guided by camera images.
            Walls, walls, "walls";
            /// Get up and stand.
            GetUp, get_up, "get-up";
            /// Catch a ball.
            BallCatch, ball_catch, "ball-catch";
        }
    };
}

macro_rules! task_names {
    ($($(#[$description:meta])* $task:ident, $section:ident, $name:literal;)*) => {
        /// A task. The section of the same name holds its parameters.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(rename_all = "kebab-case")]
        pub enum TaskName {
            $($(#[$description])* $task,)*
        }

        impl TaskName {
            /// All of them, in the order of the document.
            pub const ALL: [Self; [$($name),*].len()] = [$(Self::$task),*];

            /// As experiments and command lines write it.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$task => $name,)*
                }
            }

            pub(crate) const fn section(self) -> Section {
                match self {
                    $(Self::$task => Section(stringify!($section)),)*
                }
            }
        }
    };
}

for_each_task!(task_names);

impl std::fmt::Display for TaskName {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(self.name())
    }
}

impl std::str::FromStr for TaskName {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|task| task.name() == name)
            .ok_or_else(|| format!("no task `{name}`; tasks are {}", Self::ALL.map(Self::name).join(", ")))
    }
}

/// What a task's section tells about the task.
pub(crate) trait TaskParameters {
    /// # Errors
    /// The first field with a meaningless value, in the order of the section.
    fn check(&self, section: Section) -> Result<(), Fault>;

    /// Names of the reward terms.
    fn reward_terms(&self) -> &'static [&'static str];

    /// The parts of the task observation: name and how many numbers it has.
    ///
    /// # Errors
    /// The name of an observation that the task does not have.
    fn observations(&self) -> Result<Vec<(String, usize)>, String>;

    /// The largest reward of one step.
    fn max_reward(&self) -> f64;

    /// The field that says how camera images are drawn, and its value; `None` in a task without images.
    fn vision(&self) -> Option<(&'static str, Vision)> {
        None
    }

    /// Whether the task has a reference, which comes from the experiment's clips.
    fn follows_clips(&self) -> bool {
        false
    }
}

/// Parts of a task observation whose sizes no field changes.
fn fixed(parts: &[(&str, usize)]) -> Vec<(String, usize)> {
    parts.iter().map(|(name, size)| ((*name).to_string(), *size)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_document_writes_a_task_by_its_name() {
        for task in TaskName::ALL {
            assert_eq!(toml::Value::try_from(task).unwrap().as_str(), Some(task.name()));
            assert_eq!(task.name().parse(), Ok(task));
            assert_eq!(task.section().0, task.name().replace('-', "_"));
        }
    }
}
