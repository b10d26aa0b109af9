//! The description in an exported file.

use comic_experiment::{ACTION_SIZE, Experiment, PROPRIOCEPTION, Prior, TaskSpec};
use serde::{Deserialize, Serialize};

use super::card::Card;
use super::part::Part;
use crate::error::Error;
use crate::normaliser::NORMALISED_LIMIT;

/// Version of the file format. It changes when the same tensors get another meaning, for example if an encoder reads
/// its inputs in another order, or when fields of the experiment are renamed. Files of format 1 are read, too.
pub const FORMAT: u32 = 2;
/// Name of the input that is a camera image.
pub(super) const IMAGE: &str = "image";

/// The content of a file, its inputs and outputs, and its source.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spec {
    /// Version of the format, [`FORMAT`].
    pub format: u32,
    /// The content of the file.
    pub part: Part,
    /// The inputs, in order. The module of a TorchScript file takes them in this order.
    pub inputs: Vec<Vector>,
    /// The outputs, in order.
    pub outputs: Vec<Vector>,
    /// The normalisation of the observations.
    pub normalisation: Normalisation,
    /// The prior of a low level's latents, if one was learned with it or fitted afterwards.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prior: Option<FittedPrior>,
    /// The card of a low level, if it has one. An export has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub card: Option<Card>,
    /// The run and the checkpoint.
    pub source: Source,
    /// The resolved experiment (TOML). For a part of one task, it has only that task.
    pub experiment: String,
}

/// An input or output: a row of numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vector {
    /// Its name. The name of a task observation is `observation:TASK`.
    pub name: String,
    /// Number of entries.
    pub size: usize,
    /// What the numbers are.
    pub meaning: String,
    /// Its named parts in order; empty if the parts have no names.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub entries: Vec<Entry>,
}

/// A named part of a vector. Parts of observations have dm_control's names without `walker/`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// Its name.
    pub name: String,
    /// Number of entries.
    pub size: usize,
}

/// The normalisation of proprioception and task observations: o becomes (o − mean) / std, clamped to ±limit. The
/// tensors are `normaliser.proprioception_mean` and `…_std`, and `normaliser.task_mean` and `…_std` with a row for each
/// task.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normalisation {
    /// False if observations are not normalised.
    pub active: bool,
    /// Limit of normalised observations, standard deviations.
    pub limit: f64,
}

/// The prior p(z | s) in a file of a low level: a Gaussian of the latent, whose mean and standard deviation depend on
/// proprioception. The tensors are `prior.…`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FittedPrior {
    /// Hidden sizes.
    pub hidden: Vec<usize>,
    /// Latents that it was fitted to; 0 if it was learned with the encoder.
    pub latents: u64,
    /// Mean −ln p(z | s) of latents that it was not fitted to, nats.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub nats: Option<f64>,
    /// Mean −ln N(z; 0, I) of the same latents, nats.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub standard_nats: Option<f64>,
}

impl FittedPrior {
    /// The prior that was learned with the encoders of this experiment, if there is one.
    fn learned(experiment: &Experiment) -> Option<Self> {
        match &experiment.network.latent.prior {
            Prior::State { hidden } => {
                Some(Self { hidden: hidden.clone(), latents: 0, nats: None, standard_nats: None })
            }
            Prior::Standard | Prior::Ar1 { .. } => None,
        }
    }
}

/// The run and the checkpoint that a file comes from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Source {
    /// The program and its version.
    pub program: String,
    /// The run's name.
    pub run: String,
    /// The checkpoint's name.
    pub checkpoint: String,
    /// Updates up to the checkpoint.
    pub updates: u64,
    /// Environment steps up to the checkpoint.
    pub environment_steps: u64,
    /// The learner epoch; versions are numbered within one epoch.
    pub epoch: u64,
    /// The newest published version of the parameters.
    pub version: u64,
    /// The experiment's seed.
    pub seed: u64,
}

impl Spec {
    /// The description of a part, for an `experiment` that has only the tasks of the part.
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
            prior: if part == Part::LowLevel { FittedPrior::learned(experiment) } else { None },
            card: None,
            source,
            experiment: experiment.to_toml().map_err(Error::Experiment)?,
        })
    }
}

/// The sizes of the experiment's tasks. A policy does not depend on the clips.
pub(super) fn task_spec(experiment: &Experiment) -> Result<TaskSpec, Error> {
    TaskSpec::new(experiment, Vec::new()).map_err(no_observation)
}

fn no_observation(name: String) -> Error {
    Error::Metadata {
        field: "experiment".into(),
        problem: format!("names an observation that tracking does not have: `{name}`"),
    }
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
    Vector::of("proprioception", entries, "state of the body: rad, m, s; joints in control order")
}

/// The task observations, and the camera image.
fn observations(experiment: &Experiment, sizes: &TaskSpec) -> Result<Vec<Vector>, Error> {
    let mut vectors = Vec::new();
    for (task, _) in experiment.tasks() {
        let entries = experiment.observations(task).map_err(no_observation)?;
        vectors.push(Vector::of(format!("observation:{task}"), entries, "task observation"));
    }
    if sizes.image > 0 {
        let meaning = "uint8: 64 rows of 64 pixels of red, green and blue, from the egocentric camera";
        vectors.push(Vector::plain(IMAGE, sizes.image, meaning));
    }
    Ok(vectors)
}

fn policy(experiment: &Experiment, sizes: &TaskSpec) -> Result<(Vec<Vector>, Vec<Vector>), Error> {
    let recurrent = || {
        let entries = [
            ("latent", experiment.latent_size()),
            ("state", experiment.state_size()),
            ("low_level_state", experiment.frozen_state_size()),
        ];
        let entries = entries.into_iter().filter(|(name, size)| *name != "low_level_state" || *size > 0);
        let entries = entries.map(|(name, size)| (name.to_string(), size));
        Vector::of("recurrent_state", entries, "output of the previous step; zeros at the first step of an episode")
    };
    let mut inputs = vec![proprioception()];
    inputs.extend(observations(experiment, sizes)?);
    inputs.push(recurrent());
    let meaning =
        "without noise: the mean, or the mean of a mixture's most likely component; within [-1, 1], in control order";
    Ok((inputs, vec![Vector::plain("action", ACTION_SIZE, meaning), recurrent()]))
}

fn encoder(experiment: &Experiment, sizes: &TaskSpec) -> Result<(Vec<Vector>, Vec<Vector>), Error> {
    let network = &experiment.network;
    let latent = network.latent.size;
    let previous = Vector::plain("previous_latent", latent, "zeros at the first step of an episode");
    let mut inputs = observations(experiment, sizes)?;
    inputs.extend([proprioception(), previous]);
    let mean = match network.latent.prior {
        Prior::State { .. } => "mean of the diagonal Gaussian of the latent: the prior's mean and the encoder's output",
        Prior::Standard | Prior::Ar1 { .. } => "mean of the diagonal Gaussian of the latent",
    };
    let outputs = match latent {
        0 => vec![Vector::plain("weights", network.primitives.count, "weights of the primitives, before the gate")],
        latent => vec![
            Vector::plain("latent_mean", latent, mean),
            Vector::plain("latent_std", latent, "standard deviation of the latent"),
        ],
    };
    Ok((inputs, outputs))
}

fn low_level(experiment: &Experiment, sizes: &TaskSpec) -> (Vec<Vector>, Vec<Vector>) {
    let network = &experiment.network;
    let intent = match network.latent.size {
        0 => Vector::plain("weights", network.primitives.count, "weights of the primitives, before the gate"),
        latent => Vector::plain("latent", latent, "output of the encoder"),
    };
    let state =
        || Vector::plain("state", network.state_size(), "recurrent state; zeros at the first step of an episode");
    let components = network.components();
    let actions = components * sizes.action;
    let mut outputs = vec![
        Vector::plain("mean", actions, "mean of each component; in control order"),
        Vector::plain("std", actions, "standard deviation of each component"),
    ];
    if components > 1 {
        outputs.push(Vector::plain("log_weights", components, "logarithms of the weights of the components"));
    }
    outputs.push(state());
    (vec![intent, proprioception(), state()], outputs)
}
