//! The forward pass through libtorch.

use comic_experiment::{ACTION_SIZE, Experiment, InitialPose, TaskSpec};
use comic_networks::export::Exported;
use comic_networks::{FrozenLowLevel, Policy, RecurrentState, Routing, new_policy};
use comic_proto::Field;
use tch::nn::VarStore;
use tch::{Device, TchError, Tensor};

use crate::Error;
use crate::forward_pass::{ActingBatch, Actuated, ForwardPass, LowLevelShape};

/// The behaviour policy: its networks and their parameters, on the CPU.
#[derive(Debug)]
pub struct TorchPolicy {
    store: VarStore,
    policy: Box<dyn Policy>,
    /// In transfer: what turns the policy's latents into commands.
    low_level: Option<FrozenLowLevel>,
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
    /// Freshly initialised networks of the experiment, drawn from `seed`. In transfer `low_level` is the file of the frozen low
    /// level.
    ///
    /// `mean_action` (`[A]`, control order) is the clips' mean pose as an action. It is called only if the experiment
    /// starts there.
    ///
    /// # Errors
    /// What `mean_action` returns; [`Error::Misfit`] when the low level is missing or does not fit.
    pub fn untrained(
        spec: &TaskSpec,
        experiment: &Experiment,
        low_level: Option<&[u8]>,
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
        let policy = new_policy(&store.root(), spec, experiment, &pose).map_err(misfit)?;
        let low_level = match low_level {
            _ if !experiment.transfer.is_on() => None,
            Some(file) => {
                let frozen = Exported::read(file.to_vec()).and_then(|file| file.freeze_for(experiment));
                Some(frozen.map_err(misfit)?)
            }
            None => {
                return Err(misfit(
                    "the low level of transfer.low_level is missing: name a checkpoint, or leave that field empty",
                ));
            }
        };
        Ok(Self { store, policy, low_level, tasks: spec.tasks.len() })
    }

    /// The networks of the experiment with these parameters (safetensors), and in transfer with this low level (its file).
    ///
    /// # Errors
    /// [`Error::Misfit`] when a name, shape, type or value does not fit.
    pub fn from_parameters(
        spec: &TaskSpec,
        experiment: &Experiment,
        low_level: Option<&[u8]>,
        parameters: &[u8],
    ) -> Result<Self, Error> {
        let mut policy = Self::untrained(spec, experiment, low_level, 0, || Ok([0.0; 56]))?;
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
        let matrix = |values: &[f32]| matrix(values, environments);
        comic_networks::acting(|| {
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

    fn low_level(&self) -> Option<LowLevelShape> {
        self.low_level.as_ref().map(|frozen| LowLevelShape { command: ACTION_SIZE, state: frozen.state_size() })
    }

    fn actuate(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        match &self.low_level {
            Some(frozen) => actuate(frozen, batch),
            None => {
                batch.command.copy_from_slice(&batch.action);
                Ok(())
            }
        }
    }

    fn action_derivatives(&mut self, actuated: Actuated) -> Result<Vec<f32>, Error> {
        let Some(frozen) = &self.low_level else { return Ok(actuated.derivatives) };
        let matrix = |values: &[f32]| matrix(values, actuated.steps as i64);
        let derivatives = frozen.action_derivatives(
            &matrix(&actuated.action)?,
            &matrix(&actuated.proprioception)?,
            &matrix(&actuated.low_level_state)?,
            &matrix(&actuated.derivatives)?,
        )?;
        let mut found = vec![0.0; actuated.action.len()];
        read(&derivatives, &mut found)?;
        Ok(found)
    }
}

/// Turns the chosen actions into commands by a frozen low level.
pub(crate) fn actuate(frozen: &FrozenLowLevel, batch: &mut ActingBatch) -> Result<(), Error> {
    let environments = batch.environments() as i64;
    let matrix = |values: &[f32]| matrix(values, environments);
    comic_networks::acting(|| {
        let (action, proprioception) = (matrix(&batch.action)?, matrix(&batch[Field::Proprioception])?);
        let (command, state) = frozen.act(&action, &proprioception, &matrix(&batch.low_level_state)?);
        read(&command, &mut batch.command)?;
        read(&state, &mut batch.low_level_state)?;
        Ok(())
    })
}

/// A tensor `[environments, width]` of these values.
fn matrix(values: &[f32], environments: i64) -> Result<Tensor, TchError> {
    let width = values.len() as i64 / environments.max(1);
    Tensor::f_from_slice(values)?.f_view([environments, width])
}

fn read(tensor: &Tensor, values: &mut [f32]) -> Result<(), TchError> {
    match values {
        [] => Ok(()),
        values => tensor.f_copy_data(values, values.len()),
    }
}
