//! The forward pass through libtorch.

use comic_experiment::{Experiment, InitialPose, TaskSpec};
use comic_networks::{Policy, RecurrentState, Routing};
use comic_proto::Field;
use tch::nn::VarStore;
use tch::{Device, Tensor};

use crate::Error;
use crate::forward_pass::{ActingBatch, ForwardPass};

/// The behaviour policy: its networks and their parameters, on the CPU.
#[derive(Debug)]
pub struct TorchPolicy {
    store: VarStore,
    policy: Policy,
    /// Number of tasks.
    tasks: usize,
}

/// Makes libtorch use one thread for a forward pass, since environments are spread over threads already. Call it once,
/// before any other use of libtorch.
pub fn use_one_torch_thread() {
    tch::set_num_interop_threads(1);
    tch::set_num_threads(1);
}

impl TorchPolicy {
    /// Freshly initialised networks of the experiment, drawn from `seed`.
    ///
    /// `mean_action` (`[A]`, control order) is the clips' mean pose as an action. It is called only if the experiment
    /// starts there.
    ///
    /// # Errors
    /// What `mean_action` returns.
    pub fn untrained(
        spec: &TaskSpec,
        experiment: &Experiment,
        seed: u64,
        mean_action: impl FnOnce() -> Result<[f64; 56], Error>,
    ) -> Result<Self, Error> {
        let pose = match experiment.network.initial_pose {
            InitialPose::MidRange => vec![0.0; spec.action],
            InitialPose::ReferenceMean => mean_action()?.iter().map(|value| *value as f32).collect(),
        };
        // libtorch takes signed seeds; two's complement maps every seed to one.
        tch::manual_seed(seed.cast_signed());
        let store = VarStore::new(Device::Cpu);
        let policy = Policy::new(&store.root(), spec, &experiment.network, &pose).map_err(misfit)?;
        Ok(Self { store, policy, tasks: spec.tasks.len() })
    }

    /// The networks of the experiment with these parameters (safetensors).
    ///
    /// # Errors
    /// [`Error::Misfit`] when a name, shape, type or value does not fit.
    pub fn from_parameters(spec: &TaskSpec, experiment: &Experiment, parameters: &[u8]) -> Result<Self, Error> {
        let mut policy = Self::untrained(spec, experiment, 0, || Ok([0.0; 56]))?;
        policy.load(parameters)?;
        Ok(policy)
    }

    /// The parameters as safetensors.
    ///
    /// # Errors
    /// [`Error::Misfit`] when they cannot be written.
    pub fn to_parameters(&self) -> Result<Vec<u8>, Error> {
        comic_networks::to_safetensors(&self.store).map_err(misfit)
    }
}

fn misfit(error: impl std::fmt::Display) -> Error {
    Error::Misfit { reason: error.to_string() }
}

impl ForwardPass for TorchPolicy {
    fn load(&mut self, parameters: &[u8]) -> Result<(), Error> {
        comic_networks::from_safetensors(&mut self.store, parameters).map_err(misfit)
    }

    fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        let environments = batch.environments() as i64;
        let matrix = |values: &[f32]| {
            let width = values.len() as i64 / environments.max(1);
            Tensor::f_from_slice(values)?.f_view([environments, width])
        };
        tch::no_grad(|| {
            let image = (!batch.image.is_empty())
                .then(|| Tensor::f_from_slice(&batch.image)?.f_view([environments, -1]))
                .transpose()?;
            let observation = self.policy.normalise(
                &matrix(&batch[Field::Proprioception])?,
                &matrix(&batch[Field::Task])?,
                image.as_ref(),
                &Routing::grouped(&batch.tasks, self.tasks),
            );
            let acting = self.policy.act(
                &observation,
                &matrix(&batch[Field::PreviousLatent])?,
                &matrix(&batch[Field::LatentNoise])?,
                RecurrentState { state: &matrix(&batch[Field::State])?, first: None },
            );
            let (mean, std, log_weights) = acting.action.to_rows();
            let read = |tensor: &Tensor, values: &mut [f32]| match values {
                [] => Ok(()),
                values => tensor.f_copy_data(values, values.len()),
            };
            read(&acting.latent, &mut batch.latent)?;
            read(&mean, &mut batch[Field::Mean])?;
            read(&std, &mut batch[Field::Std])?;
            read(&acting.state, &mut batch[Field::State])?;
            if let Some(log_weights) = log_weights {
                read(&log_weights, &mut batch[Field::LogWeights])?;
            }
            Ok(())
        })
    }
}
