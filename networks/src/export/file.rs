//! Writes and reads exported files.

use std::collections::HashMap;
use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use comic_experiment::{Experiment, Network, TaskSpec, Transfer, TransferPrior};
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use sha2::{Digest as _, Sha256};
use tch::{Device, nn};

use super::card::Card;
use super::part::Part;
use super::spec::{FORMAT, FittedPrior, Source, Spec, task_spec};
use super::weights;
use crate::algorithms::new_policy;
use crate::error::Error;
use crate::frozen::FrozenLowLevel;
use crate::parameters;
use crate::policy::Policy;
use crate::prior::StatePrior;

/// The key of the [`Spec`] in the metadata.
pub const KEY: &str = "comic";
/// In the policy of a transfer: the tensor whose bytes are the file of the frozen low level, unchanged.
const LOW_LEVEL_FILE: &str = "low_level_file";
/// Most hidden layers of a prior, and most units of each.
const LAYERS: usize = 16;
const UNITS: usize = 16384;
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
    /// (safetensors). In transfer `low_level` is the file of the frozen low level, which becomes part of the policy.
    ///
    /// # Errors
    /// [`Error`], if the experiment does not have the task, or the parameters are not those of the experiment.
    pub fn new(
        part: Part,
        experiment: &Experiment,
        source: Source,
        policy: &[u8],
        low_level: Option<&[u8]>,
    ) -> Result<Self, Error> {
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
        if let Some(file) = low_level {
            views.push((LOW_LEVEL_FILE.to_string(), TensorView::new(Dtype::U8, vec![file.len()], file)?));
        }
        Self::written(views, &Spec::new(part, &own, source)?)
    }

    /// The file of these tensors with this description.
    fn written(views: Vec<(String, TensorView<'_>)>, spec: &Spec) -> Result<Self, Error> {
        let text = serde_json::to_string(spec)
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
        let exported = Self::read_outside(bytes)?;
        exported.frozen_low_level()?;
        Ok(exported)
    }

    /// Like [`read`](Self::read), without looking into a frozen low level inside. So a file inside a file inside a file cannot
    /// exhaust the stack.
    fn read_outside(bytes: Vec<u8>) -> Result<Self, Error> {
        let (_, metadata) = SafeTensors::read_metadata(&bytes)?;
        let text = metadata.metadata().as_ref().and_then(|entries| entries.get(KEY));
        let spec = parse(text.ok_or_else(|| wrong(KEY, "is missing: `comic-learner export` writes it"))?)?;
        let read = if spec.format == FORMAT { Experiment::from_toml } else { Experiment::from_earlier_toml };
        let experiment = read("its experiment", &spec.experiment).map_err(Error::Experiment)?;
        agree(&spec, &experiment)?;
        let sizes = task_spec(&experiment)?;
        let prior = spec.prior.as_ref().map(|prior| &prior.hidden[..]);
        let expected = weights::count(spec.part, prior, &sizes, &experiment);
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

    /// The bytes of the frozen low level's file in the policy of a transfer; `None` in any other file.
    ///
    /// # Errors
    /// [`Error::Metadata`], if the policy of a transfer does not have it, or has another than its experiment names.
    pub fn low_level_file(&self) -> Result<Option<&[u8]>, Error> {
        if !self.experiment.transfer.is_on() {
            return Ok(None);
        }
        let document = SafeTensors::deserialize(&self.bytes)?;
        let view = document.tensor(LOW_LEVEL_FILE).map_err(|_| Error::Missing { name: LOW_LEVEL_FILE.into() })?;
        if view.dtype() != Dtype::U8 {
            let found = format!("{:?}", view.dtype());
            return Err(wrong(LOW_LEVEL_FILE, format!("holds {found} and not bytes (U8): export the policy again")));
        }
        let (found, expected) = (hex::encode(Sha256::digest(view.data())), &self.experiment.transfer.sha256);
        if found != *expected {
            let problem = format!("is {expected}, but the file's low level has the SHA-256 {found}: export it again");
            return Err(wrong("transfer.sha256", problem));
        }
        Ok(Some(view.data()))
    }

    /// The parameters of this part alone, as safetensors: without a frozen low level's file.
    ///
    /// # Errors
    /// [`Error::Malformed`]; never for a file that was read.
    pub fn parameters(&self) -> Result<Vec<u8>, Error> {
        let document = SafeTensors::deserialize(&self.bytes)?;
        let own = document.tensors().into_iter().filter(|(name, _)| name != LOW_LEVEL_FILE);
        Ok(safetensors::serialize(own, None)?)
    }

    /// The frozen low level in the policy of a transfer; `None` in any other file.
    ///
    /// # Errors
    /// As [`low_level_file`](Self::low_level_file), and what is wrong with that file.
    pub(super) fn frozen_low_level(&self) -> Result<Option<FrozenLowLevel>, Error> {
        let Some(file) = self.low_level_file()? else { return Ok(None) };
        Self::read_outside(file.to_vec())?.freeze_for(&self.experiment).map(Some)
    }

    /// Makes `network` describe the low level of this file: its kind, its sizes and its latent.
    ///
    /// # Errors
    /// [`Error::NotLowLevel`], if the file holds another part, or a low level without a latent.
    pub fn describe_low_level(&self, network: &mut Network) -> Result<(), Error> {
        let own = &self.experiment.network;
        let refuse = |problem| Err(Error::NotLowLevel { problem });
        match (self.spec.part, own.latent.size) {
            (Part::LowLevel, 0) => {
                return refuse("it was learned with network.latent.size = 0, so it reads no latent".into());
            }
            (Part::LowLevel, _) => {}
            (part, _) => return refuse(format!("the file holds `{part}`: export the low level with --part low-level")),
        }
        let Network { low_level, mlp, lstm, primitives, .. } = own.clone();
        *network = Network { low_level, mlp, lstm, primitives, ..network.clone() };
        network.latent.size = own.latent.size;
        Ok(())
    }

    /// The low level of this file, frozen, for a transfer of this experiment.
    ///
    /// # Errors
    /// As of [`freeze`](Self::freeze), and if the experiment describes another low level.
    pub fn freeze_for(&self, experiment: &Experiment) -> Result<FrozenLowLevel, Error> {
        let mut described = experiment.network.clone();
        self.describe_low_level(&mut described)?;
        if described != experiment.network {
            let problem = "it has other sizes than the experiment: use the low level that the run began with";
            return Err(Error::NotLowLevel { problem: problem.into() });
        }
        self.freeze(&experiment.transfer)
    }

    /// The low level of this file, frozen.
    ///
    /// # Errors
    /// As of [`describe_low_level`](Self::describe_low_level), and if the transfer wants a prior and the file has none.
    pub fn freeze(&self, transfer: &Transfer) -> Result<FrozenLowLevel, Error> {
        self.describe_low_level(&mut self.experiment.network.clone())?;
        let prior = self.spec.prior.as_ref().map(|prior| &prior.hidden[..]);
        if transfer.prior == TransferPrior::State && prior.is_none() {
            let problem =
                "it has no prior of the state, which transfer.prior = \"state\" needs: `comic-learner prior` fits one";
            return Err(Error::NotLowLevel { problem: problem.into() });
        }
        let active = self.spec.normalisation.active;
        let (mut store, frozen) = FrozenLowLevel::new(&self.experiment.network, active, prior, transfer);
        self.load(&store)?;
        store.freeze();
        Ok(frozen)
    }

    /// The same low level with parameters that were never trained, drawn from `seed`, and without a card. The normaliser stays.
    ///
    /// # Errors
    /// As of [`describe_low_level`](Self::describe_low_level).
    pub fn untrained(&self, seed: u64) -> Result<Self, Error> {
        self.describe_low_level(&mut self.experiment.network.clone())?;
        tch::manual_seed(seed.cast_signed());
        let (store, _) = self.policy(&task_spec(&self.experiment)?)?;
        let fresh = parameters::to_safetensors(&store)?;
        let (fresh, own) = (SafeTensors::deserialize(&fresh)?, SafeTensors::deserialize(&self.bytes)?);
        let mut views = Vec::new();
        for (name, view) in own.tensors() {
            let view = if name.starts_with("low_level.") { fresh.tensor(&name)? } else { view };
            views.push((name, view));
        }
        Self::written(views, &Spec { card: None, ..self.spec.clone() })
    }

    /// The same low level with a prior of its latents, whose parameters are in `store` under the path `prior`. An earlier prior
    /// is replaced. The new file has no card.
    ///
    /// # Errors
    /// As of [`describe_low_level`](Self::describe_low_level), and if the parameters are not those of `prior`.
    pub fn with_prior(&self, prior: FittedPrior, store: &nn::VarStore) -> Result<Self, Error> {
        self.describe_low_level(&mut self.experiment.network.clone())?;
        let own = SafeTensors::deserialize(&self.bytes)?;
        let fitted = parameters::to_safetensors(store)?;
        let fitted = SafeTensors::deserialize(&fitted)?;
        let kept = own.tensors().into_iter().filter(|(name, _)| !name.starts_with("prior."));
        let views: Vec<_> = kept.chain(fitted.tensors()).collect();
        let spec = Spec { prior: Some(prior), card: None, ..self.spec.clone() };
        Self::written(views, &spec)
    }

    /// The same low level with this card. An earlier card is replaced.
    ///
    /// # Errors
    /// As of [`describe_low_level`](Self::describe_low_level).
    pub fn with_card(&self, card: Card) -> Result<Self, Error> {
        self.describe_low_level(&mut self.experiment.network.clone())?;
        let own = SafeTensors::deserialize(&self.bytes)?;
        Self::written(own.tensors(), &Spec { card: Some(card), ..self.spec.clone() })
    }

    /// Sets the parameters of this part in `store` by their names. All other parameters stay unchanged.
    ///
    /// # Errors
    /// [`Error`], if names or shapes differ; then `store` is unchanged.
    pub fn load(&self, store: &nn::VarStore) -> Result<(), Error> {
        let mut variables = store.variables();
        variables.retain(|name, _| self.spec.part.holds(name));
        let other = self.experiment.transfer.is_on().then_some(LOW_LEVEL_FILE);
        parameters::set(&variables, &self.bytes, other)
    }

    /// New networks of the experiment, [alone](Part::alone), and of the prior if the file has one.
    pub(super) fn policy(&self, sizes: &TaskSpec) -> Result<(nn::VarStore, Box<dyn Policy>), Error> {
        let store = nn::VarStore::new(Device::Cpu);
        let experiment = self.spec.part.alone(&self.experiment);
        let policy = new_policy(&store.root(), sizes, &experiment, &vec![0.0; sizes.action])?;
        if let Some(prior) = &self.spec.prior {
            StatePrior::new(&(store.root() / "prior"), sizes.proprioception, &self.experiment.network, &prior.hidden);
        }
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
    if value["format"] != FORMAT && value["format"] != FORMAT - 1 {
        let (found, before) = (&value["format"], FORMAT - 1);
        let problem = format!("is {found}, but this program reads {before} and {FORMAT}: export the policy again");
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
    if let Some(prior) = &spec.prior {
        let sizes = &prior.hidden;
        let holds = (1..=LAYERS).contains(&sizes.len()) && sizes.iter().all(|size| (1..=UNITS).contains(size));
        if spec.part != Part::LowLevel || !holds {
            return Err(wrong("prior", "is not that of a low level with 1 to 16 layers of 1 to 16384 units"));
        }
    }
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
