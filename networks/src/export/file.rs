//! Writes and reads exported files.

use std::collections::HashMap;
use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use comic_experiment::{Experiment, TaskSpec};
use safetensors::SafeTensors;
use safetensors::tensor::TensorView;
use tch::{Device, nn};

use super::part::Part;
use super::spec::{FORMAT, Source, Spec, task_spec};
use super::weights;
use crate::error::Error;
use crate::parameters;
use crate::policy::Policy;

/// The key of the [`Spec`] in the metadata.
pub const KEY: &str = "comic";
/// Greatest length of a file, bytes.
pub const LONGEST: u64 = 1 << 30;

/// A complete policy or part of a policy: every tensor that its [`Spec`] describes exists and is valid.
#[derive(Clone, Debug)]
pub struct Exported {
    /// The description.
    pub spec: Spec,
    /// The experiment of the description.
    pub experiment: Experiment,
    /// The content of the file: safetensors, with the description in the metadata.
    pub bytes: Vec<u8>,
}

impl Exported {
    /// Extracts a part of a checkpoint, given the checkpoint's experiment and the parameters of its policy
    /// (safetensors).
    ///
    /// # Errors
    /// [`Error`], if the experiment does not have the task, or the parameters are not those of the experiment.
    pub fn new(part: Part, experiment: &Experiment, source: Source, policy: &[u8]) -> Result<Self, Error> {
        let own = part.of(experiment)?;
        let sizes = task_spec(&own)?;
        let index = experiment.tasks().iter().position(|(task, _)| Some(*task) == part.task());
        let document = SafeTensors::deserialize(policy)?;
        let mut views = Vec::new();
        for (name, view) in document.tensors().into_iter().filter(|(name, _)| part.holds(name)) {
            let view = match index {
                Some(index) if name.starts_with("normaliser.task_") => row(&view, index, sizes.task)?,
                _ => view,
            };
            views.push((name, view));
        }
        let spec = Spec::new(part, &own, source)?;
        let text = serde_json::to_string(&spec)
            .map_err(|error| Error::Metadata { field: KEY.into(), problem: format!("cannot be written: {error}") })?;
        // Reading checks the result in the same way as for every reader.
        Self::read(safetensors::serialize(views, Some(HashMap::from([(KEY.to_string(), text)])))?)
    }

    /// Reads a file. The file may come from anywhere.
    ///
    /// # Errors
    /// [`Error`]: what is wrong with the file, and what to do.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let mut bytes = Vec::new();
        File::open(path).and_then(|file| file.take(LONGEST + 1).read_to_end(&mut bytes)).map_err(Error::File)?;
        if bytes.len() as u64 > LONGEST {
            return Err(Error::Long { most: LONGEST });
        }
        Self::read(bytes)
    }

    /// Reads a file from its bytes.
    ///
    /// # Errors
    /// As [`Exported::open`].
    pub fn read(bytes: Vec<u8>) -> Result<Self, Error> {
        let (_, metadata) = SafeTensors::read_metadata(&bytes)?;
        let text = metadata.metadata().as_ref().and_then(|entries| entries.get(KEY));
        let spec = parse(text.ok_or_else(|| wrong(KEY, "is missing: `comic-learner export` writes it"))?)?;
        let experiment = Experiment::from_toml("its experiment", &spec.experiment).map_err(Error::Experiment)?;
        agree(&spec, &experiment)?;
        let sizes = task_spec(&experiment)?;
        let expected = weights::count(spec.part, &sizes, &experiment.network);
        let counted = metadata.tensors().into_iter().filter(|(name, info)| weights::is_counted(name, &info.shape));
        let found: u64 = counted.map(|(_, info)| info.shape.iter().map(|size| *size as u64).product::<u64>()).sum();
        if expected != found {
            let problem =
                format!("describes networks of {expected} weights, but the file has {found}: export the policy again");
            return Err(wrong("experiment", problem));
        }
        let exported = Self { spec, experiment, bytes };
        exported.load(&exported.policy(&sizes)?.0)?;
        Ok(exported)
    }

    /// Sets the parameters of this part in `store` by their names. All other parameters stay unchanged.
    ///
    /// # Errors
    /// [`Error`], if names or shapes differ; then `store` is unchanged.
    pub fn load(&self, store: &nn::VarStore) -> Result<(), Error> {
        let mut variables = store.variables();
        variables.retain(|name, _| self.spec.part.holds(name));
        parameters::set(&variables, &self.bytes)
    }

    /// New networks of the experiment.
    pub(super) fn policy(&self, sizes: &TaskSpec) -> Result<(nn::VarStore, Policy), Error> {
        let store = nn::VarStore::new(Device::Cpu);
        let policy = Policy::new(&store.root(), sizes, &self.experiment.network, &vec![0.0; sizes.action])?;
        Ok((store, policy))
    }
}

/// The last `width` entries of row `index` of a matrix `[tasks, X]`, as a matrix `[1, width]`.
fn row<'a>(view: &TensorView<'a>, index: usize, width: usize) -> Result<TensorView<'a>, Error> {
    let size = size_of::<f32>();
    let longest = view.shape().last().copied().unwrap_or(0);
    let end = (index + 1) * longest * size;
    let data = view.data().get(end.saturating_sub(width * size)..end).filter(|_| width <= longest);
    let data = data.ok_or_else(|| wrong("normaliser.task_mean", "has no row of this task in the checkpoint"))?;
    Ok(TensorView::new(view.dtype(), vec![1, width], data)?)
}

fn parse(text: &str) -> Result<Spec, Error> {
    let malformed = |error: serde_json::Error| wrong(KEY, format!("is not a valid description: {error}"));
    let value: serde_json::Value = serde_json::from_str(text).map_err(malformed)?;
    // The format is checked first, because another format has other fields.
    if value["format"] != FORMAT {
        let problem = format!("is {}, but this program reads {FORMAT}: export the policy again", value["format"]);
        return Err(wrong("format", problem));
    }
    serde_json::from_value(value).map_err(malformed)
}

/// Checks that the description is the one that this program makes for the experiment. So a file whose observations are
/// in another order is refused and not misread.
fn agree(spec: &Spec, experiment: &Experiment) -> Result<(), Error> {
    let own = spec.part.of(experiment)?;
    let made = Spec::new(spec.part, &own, spec.source.clone())?;
    let fields = [
        ("experiment", own == *experiment),
        ("inputs", spec.inputs == made.inputs),
        ("outputs", spec.outputs == made.outputs),
        ("normalisation", spec.normalisation == made.normalisation),
    ];
    match fields.into_iter().find(|(_, same)| !same) {
        Some((field, _)) => {
            Err(wrong(field, "differs from what this release writes: export the policy again with this release"))
        }
        None => Ok(()),
    }
}

fn wrong(field: &str, problem: impl Into<String>) -> Error {
    Error::Metadata { field: field.into(), problem: problem.into() }
}
