//! The content of an exported file.

use comic_experiment::{Experiment, LowLevelName, Prior, TaskName};
use serde::{Deserialize, Serialize};

use crate::error::Error;

/// The content of an exported file. Command line and file write it as `policy`, `policy:TASK`, `encoder:TASK` or
/// `low-level`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Part {
    /// The whole policy, of all tasks or of one.
    Policy(Option<TaskName>),
    /// The encoder of one task, the image encoder, the statistics that normalise their inputs, and the prior of the state from
    /// whose mean the latent is a difference, if there is one.
    Encoder(TaskName),
    /// The low level, with the statistics that normalise proprioception, and a prior of its latents if one was learned or
    /// fitted.
    LowLevel,
}

impl Part {
    /// The task of the part; `None` for a part of all tasks.
    pub fn task(self) -> Option<TaskName> {
        match self {
            Self::Policy(task) => task,
            Self::Encoder(task) => Some(task),
            Self::LowLevel => None,
        }
    }

    /// Whether the parameter with this name in a checkpoint belongs to the part.
    pub(crate) fn holds(self, name: &str) -> bool {
        let of = |task: TaskName| name.strip_prefix("encoder.").and_then(|rest| rest.strip_prefix(task.name()));
        let encodes = |task| of(task).is_some_and(|rest| rest.starts_with('.'));
        match self {
            Self::Policy(None) => true,
            Self::Policy(Some(task)) => !name.starts_with("encoder.") || encodes(task),
            Self::Encoder(task) => {
                let shared = ["image_encoder.", "normaliser.", "prior."];
                encodes(task) || shared.iter().any(|start| name.starts_with(start))
            }
            Self::LowLevel => {
                ["low_level.", "normaliser.proprioception_", "prior."].iter().any(|start| name.starts_with(start))
            }
        }
    }

    /// The experiment with the networks that this part does not hold as small as they can be. A file of the part describes
    /// them, too, and a small file must not make its reader build huge ones.
    pub(super) fn alone(self, experiment: &Experiment) -> Experiment {
        let mut alone = experiment.clone();
        let network = &mut alone.network;
        match self {
            Self::Policy(_) => {}
            Self::Encoder(_) => {
                (network.low_level, network.mlp.hidden) = (LowLevelName::Mlp, vec![1]);
            }
            Self::LowLevel => {
                (network.encoder, network.encoder_linear_path, network.image_features) = (vec![1], false, 1);
                // The description has the sizes: a prior that was fitted afterwards may have replaced the one that was learned.
                network.latent.prior = Prior::Standard;
            }
        }
        alone
    }

    /// The experiment of this part. For a part of one task, it is the experiment with only that task.
    ///
    /// # Errors
    /// [`Error::NoTask`] if the experiment has no such task.
    pub(crate) fn of(self, experiment: &Experiment) -> Result<Experiment, Error> {
        if !experiment.learns_low_level() && !matches!(self, Self::Policy(_)) {
            return Err(Error::Transfer { part: self.to_string() });
        }
        let Some(task) = self.task() else { return Ok(experiment.clone()) };
        let tasks: Vec<TaskName> = experiment.tasks().into_iter().map(|(task, _)| task).collect();
        if !tasks.contains(&task) {
            let known = tasks.iter().map(|task| task.name()).collect::<Vec<_>>().join(", ");
            return Err(Error::NoTask { task: task.to_string(), known });
        }
        Ok(Experiment { task, joint: Vec::new(), ..experiment.clone() })
    }
}

impl std::fmt::Display for Part {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Policy(None) => formatter.write_str("policy"),
            Self::Policy(Some(task)) => write!(formatter, "policy:{task}"),
            Self::Encoder(task) => write!(formatter, "encoder:{task}"),
            Self::LowLevel => formatter.write_str("low-level"),
        }
    }
}

impl std::str::FromStr for Part {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once(':') {
            None if text == "policy" => Ok(Self::Policy(None)),
            None if text == "low-level" => Ok(Self::LowLevel),
            Some(("policy", task)) => Ok(Self::Policy(Some(task.parse()?))),
            Some(("encoder", task)) => Ok(Self::Encoder(task.parse()?)),
            _ => Err(format!("no part `{text}`; parts are policy, policy:TASK, encoder:TASK and low-level")),
        }
    }
}

impl TryFrom<String> for Part {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<Part> for String {
    fn from(part: Part) -> Self {
        part.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_is_read_in_the_form_that_is_written() {
        for text in ["policy", "policy:get-up", "encoder:tracking", "low-level"] {
            assert_eq!(text.parse::<Part>().unwrap().to_string(), text);
        }
        for text in ["", "value", "encoder", "encoder:", "encoder:flying", "low-level:tracking", "policy:"] {
            assert!(text.parse::<Part>().is_err(), "{text}");
        }
    }

    #[test]
    fn a_part_holds_only_its_own_parameters() {
        let names = [
            "encoder.tracking.head.bias",
            "encoder.get-up.head.bias",
            "low_level.head.bias",
            "normaliser.proprioception_std",
            "normaliser.task_std",
            "image_encoder.first.weight",
            "prior.head.bias",
        ];
        let held = |part: &str| names.map(|name| part.parse::<Part>().unwrap().holds(name));
        assert_eq!(held("policy"), [true; 7]);
        assert_eq!(held("policy:get-up"), [false, true, true, true, true, true, true]);
        assert_eq!(held("encoder:tracking"), [true, false, false, true, true, true, true]);
        assert_eq!(held("low-level"), [false, false, true, true, false, false, true]);
    }
}
