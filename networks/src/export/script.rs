//! Writes a policy as TorchScript.

use std::fs::OpenOptions;
use std::io::Write as _;
use std::path::Path;

use tch::{CModule, Kind, Tensor};
use zip::write::FileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::file::{Exported, KEY};
use super::part::Part;
use super::spec::{IMAGE, task_spec};
use crate::error::Error;
use crate::frozen::FrozenLowLevel;
use crate::lstm::RecurrentState;
use crate::normaliser::NormalisedObservation;
use crate::policy::Policy;
use crate::routing::Routing;

impl Exported {
    /// Writes the policy of one task as TorchScript to `path`. The method `forward` of the module takes the inputs of
    /// the [`Spec`](super::spec::Spec) in their order, `[N, size]` each. It returns the outputs in one tensor `[N, A + M]`, where
    /// M is the size of the recurrent state. N is any number of environments. The module has the description as the extra file
    /// `comic.json`.
    ///
    /// # Errors
    /// [`Error::Script`] if the part is not a policy of one task; [`Error::Torch`]; [`Error::File`].
    pub fn save_script(&self, path: &Path) -> Result<(), Error> {
        self.trace()?.0.save(path)?;
        self.enclose(path).map_err(Error::File)
    }

    /// The policy of one task as a module, and examples of its inputs, `[1, size]` each.
    ///
    /// # Errors
    /// [`Error::Script`] if the part is not a policy of one task; [`Error::Torch`].
    pub(super) fn trace(&self) -> Result<(CModule, Vec<Tensor>), Error> {
        let sizes = task_spec(&self.experiment)?;
        let refused = || {
            let tasks: Vec<&str> = sizes.tasks.iter().map(|task| task.name.as_str()).collect();
            Error::Script { part: self.spec.part.to_string(), tasks: tasks.join(", ") }
        };
        if !matches!(self.spec.part, Part::Policy(_)) || sizes.tasks.len() != 1 {
            return Err(refused());
        }
        let (mut store, policy) = self.policy(&sizes)?;
        self.load(&store)?;
        // A tensor that requires a gradient cannot be a constant of a trace.
        store.freeze();
        let frozen = self.frozen_low_level()?;
        let inputs = self.spec.inputs.iter().map(|input| {
            let kind = if input.name == IMAGE { Kind::Uint8 } else { Kind::Float };
            Tensor::zeros([1, input.size as i64], (kind, store.device()))
        });
        let inputs: Vec<Tensor> = inputs.collect();
        let mut forward = |inputs: &[Tensor]| match inputs {
            [proprioception, task, image @ .., memory] => {
                let observation = policy.normalise(proprioception, task, image.first(), &Routing::single());
                vec![self.step(policy.as_ref(), frozen.as_ref(), proprioception, &observation, memory)]
            }
            _ => Vec::new(),
        };
        let module = tch::no_grad(|| CModule::create_by_tracing("Policy", "forward", &inputs, &mut forward))?;
        Ok((module, inputs))
    }

    /// Adds the description to the archive. PyTorch reads extra files from its directory `extra`; the function of tch
    /// that saves a module cannot write extra files.
    fn enclose(&self, path: &Path) -> std::io::Result<()> {
        let mut file = OpenOptions::new().read(true).write(true).open(path)?;
        let first = ZipArchive::new(&mut file)?.by_index(0)?.name().to_string();
        let root = first.split('/').next().unwrap_or_default();
        let mut archive = ZipWriter::new_append(file)?;
        let stored = FileOptions::default().compression_method(CompressionMethod::Stored);
        archive.start_file(format!("{root}/extra/{KEY}.json"), stored)?;
        archive.write_all(serde_json::to_string(&self.spec)?.as_bytes())?;
        archive.finish()?.sync_all()
    }

    /// One step without noise: the action within its bounds, the latent, and the states. `memory` has the latent, the policy's
    /// state and a frozen low level's.
    fn step(
        &self,
        policy: &dyn Policy,
        frozen: Option<&FrozenLowLevel>,
        proprioception: &Tensor,
        observation: &NormalisedObservation,
        memory: &Tensor,
    ) -> Tensor {
        let own = &self.experiment;
        let [latent, state, low_level] =
            [own.latent_size(), own.state_size(), own.frozen_state_size()].map(|size| size as i64);
        let previous = memory.narrow(1, 0, latent);
        let [state, low_level] =
            [(latent, state), (latent + state, low_level)].map(|(start, size)| memory.narrow(1, start, size));
        let recurrent = RecurrentState { state: &state, first: None };
        let acting = policy.act(observation, &previous, &previous.zeros_like(), recurrent);
        let (action, low_level) = match frozen {
            Some(frozen) => frozen.act(&acting.action.mode(), proprioception, &low_level),
            None => (acting.action.mode(), low_level),
        };
        Tensor::cat(&[action.clamp(-1.0, 1.0), acting.latent, acting.state, low_level], 1)
    }
}
