//! What a file says of itself.

use comic_experiment::{Experiment, PROPRIOCEPTION, TaskSpec};
use serde::{Deserialize, Serialize};

use super::part::Part;
use crate::error::Error;
use crate::normaliser::NORMALISED_LIMIT;

/// The form of files that this program writes and reads: another one whenever the same tensors come to mean something
/// else, as in an encoder that reads its inputs in another order.
pub const FORMAT: u32 = 1;

/// What a file holds, takes and gives, and where it comes from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spec {
    /// [`FORMAT`].
    pub format: u32,
    /// What the file holds.
    pub part: Part,
    /// What it takes, in order.
    pub inputs: Vec<Vector>,
    /// What it gives, in order.
    pub outputs: Vec<Vector>,
    /// What happens to observations first.
    pub normalisation: Normalisation,
    /// Where it comes from.
    pub source: Source,
    /// The resolved experiment (TOML); of a part of one task, as if there had been no other.
    pub experiment: String,
}

/// An input or output: a row of so many numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vector {
    /// Its name; a task's observation is `observation:TASK`.
    pub name: String,
    /// How many numbers it has.
    pub size: usize,
    /// What they are.
    pub meaning: String,
    /// What it is made of, in order, where that has names.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub entries: Vec<Entry>,
}

/// A named stretch of a vector; observations have dm_control's names without `walker/`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// Its name.
    pub name: String,
    /// How many numbers it has.
    pub size: usize,
}

/// Proprioception and task observations o become (o − mean) / std within ±limit, with the tensors
/// `normaliser.proprioception_mean`, `…_std` and, a row for each task, `normaliser.task_mean`, `…_std`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normalisation {
    /// Off, observations are taken as they are.
    pub active: bool,
    /// Standard deviations beyond which nothing is told apart.
    pub limit: f64,
}

/// Where a file comes from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Source {
    /// The program and its version.
    pub program: String,
    /// The run's name.
    pub run: String,
    /// The checkpoint's name.
    pub checkpoint: String,
    /// Updates until then.
    pub updates: u64,
    /// Environment steps until then.
    pub environment_steps: u64,
    /// The life of the learner, without which the version means nothing.
    pub epoch: u64,
    /// The newest parameters that were published.
    pub version: u64,
    /// The experiment's seed.
    pub seed: u64,
}

impl Spec {
    /// Describes a part of an `experiment` that knows of no task beyond it.
    ///
    /// # Errors
    /// [`Error::Experiment`].
    pub(super) fn new(part: Part, experiment: &Experiment, source: Source) -> Result<Self, Error> {
        let sizes = task_spec(experiment)?;
        let (inputs, outputs) = match part {
            Part::Policy(_) => policy(experiment, &sizes)?,
            Part::Encoder(_) => encoder(experiment, &sizes)?,
            Part::LowLevel => low_level(experiment, &sizes),
        };
        let active = experiment.network.normaliser_steps > 0;
        Ok(Self {
            format: FORMAT,
            part,
            inputs,
            outputs,
            normalisation: Normalisation { active, limit: NORMALISED_LIMIT },
            source,
            experiment: experiment.to_toml().map_err(Error::Experiment)?,
        })
    }
}

/// Sizes of the experiment's tasks; which clips there are is no matter of a policy.
pub(super) fn task_spec(experiment: &Experiment) -> Result<TaskSpec, Error> {
    TaskSpec::new(experiment, Vec::new()).map_err(no_observation)
}

fn no_observation(name: String) -> Error {
    Error::Metadata { field: "experiment".into(), problem: format!("names no observation of tracking: `{name}`") }
}

impl Vector {
    fn plain(name: impl Into<String>, size: usize, meaning: &str) -> Self {
        Self { name: name.into(), size, meaning: meaning.into(), entries: Vec::new() }
    }

    fn of(name: impl Into<String>, entries: impl IntoIterator<Item = (String, usize)>, meaning: &str) -> Self {
        let entries: Vec<Entry> = entries.into_iter().map(|(name, size)| Entry { name, size }).collect();
        let size = entries.iter().map(|entry| entry.size).sum();
        Self { entries, ..Self::plain(name, size, meaning) }
    }
}

fn proprioception() -> Vector {
    let entries = PROPRIOCEPTION.map(|(name, size)| (name.to_string(), size));
    Vector::of("proprioception", entries, "what the body feels: rad, m, s; joints in control order")
}

/// What the tasks show, and what is seen.
fn observations(experiment: &Experiment, sizes: &TaskSpec) -> Result<Vec<Vector>, Error> {
    let mut vectors = Vec::new();
    for (task, _) in experiment.tasks() {
        let entries = experiment.observations(task).map_err(no_observation)?;
        vectors.push(Vector::of(format!("observation:{task}"), entries, "what the task shows"));
    }
    if sizes.image > 0 {
        let meaning = "uint8: 64 rows of 64 pixels of red, green and blue, as the egocentric camera sees";
        vectors.push(Vector::plain("image", sizes.image, meaning));
    }
    Ok(vectors)
}

fn policy(experiment: &Experiment, sizes: &TaskSpec) -> Result<(Vec<Vector>, Vec<Vector>), Error> {
    let network = &experiment.network;
    let recurrent = || {
        let entries = [("latent", network.latent.size), ("state", network.state_size())];
        let entries = entries.map(|(name, size)| (name.to_string(), size));
        Vector::of("recurrent_state", entries, "what the step before gave; zeros at an episode's first step")
    };
    let mut inputs = vec![proprioception()];
    inputs.extend(observations(experiment, sizes)?);
    inputs.push(recurrent());
    let meaning = "without noise: the mean, of a mixture its likeliest component's; within [-1, 1], in control order";
    Ok((inputs, vec![Vector::plain("action", sizes.action, meaning), recurrent()]))
}

fn encoder(experiment: &Experiment, sizes: &TaskSpec) -> Result<(Vec<Vector>, Vec<Vector>), Error> {
    let network = &experiment.network;
    let latent = network.latent.size;
    let previous = Vector::plain("previous_latent", latent, "zeros at an episode's first step");
    let mut inputs = observations(experiment, sizes)?;
    inputs.extend([proprioception(), previous]);
    let outputs = match latent {
        0 => vec![Vector::plain("weights", network.primitives.count, "the primitives' weights, before the gate")],
        latent => vec![
            Vector::plain("latent_mean", latent, "the latent is a diagonal Gaussian's"),
            Vector::plain("latent_std", latent, "softplus of what the last layer gives, and a floor"),
        ],
    };
    Ok((inputs, outputs))
}

fn low_level(experiment: &Experiment, sizes: &TaskSpec) -> (Vec<Vector>, Vec<Vector>) {
    let network = &experiment.network;
    let intent = match network.latent.size {
        0 => Vector::plain("weights", network.primitives.count, "the primitives' weights, before the gate"),
        latent => Vector::plain("latent", latent, "what is to be done"),
    };
    let state = || Vector::plain("state", network.state_size(), "what is remembered; zeros at an episode's first step");
    let components = network.components();
    let actions = components * sizes.action;
    let mut outputs = vec![
        Vector::plain("mean", actions, "of each component; in control order"),
        Vector::plain("std", actions, "of each component"),
    ];
    if components > 1 {
        outputs.push(Vector::plain("log_weights", components, "logarithms of the components' weights"));
    }
    outputs.push(state());
    (vec![intent, proprioception(), state()], outputs)
}
