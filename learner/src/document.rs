//! The arguments that choose and change the experiment.

use clap::Args;
use comic_experiment::{DeviceName, Experiment};

use crate::error::{Error, Result};

/// The experiment and its changes.
#[derive(Clone, Debug, Args)]
pub struct DocumentArguments {
    /// Name of a preset (docs/experiments.md lists them), or path of an experiment file [default: tracking-mlp].
    #[arg(long, value_name = "NAME|FILE", global = true)]
    pub preset: Option<String>,
    /// Clips to track instead of the experiment's: builtin:NAME, FILE.h5, FILE.h5#SUBSET or FILE.h5#CLIP,CLIP.
    #[arg(long, value_name = "SOURCE", num_args = 1.., global = true)]
    pub clips: Vec<String>,
    /// Override any field, for instance --set vmpo.epsilon_eta=0.2.
    #[arg(long = "set", value_name = "FIELD=VALUE", global = true)]
    pub overrides: Vec<String>,
    /// Where the update runs: cpu, cuda, cuda:N, xla or xla:N. The same as --set learner.device=D.
    #[arg(long, value_name = "DEVICE", global = true)]
    pub device: Option<DeviceName>,
    /// Learn reproducibly with any number of actors, for debugging. The same as --set unroll.lockstep=true and --set
    /// unroll.ahead=0.
    #[arg(long, global = true)]
    pub lockstep: bool,
}

/// The overrides of `--lockstep`; `--set` comes after them.
const LOCKSTEP: [&str; 2] = ["unroll.lockstep=true", "unroll.ahead=0"];

impl DocumentArguments {
    /// The resolved experiment.
    ///
    /// # Errors
    /// [`Error::Experiment`], which names the file, the field and the remedy.
    pub fn resolve(&self) -> Result<Experiment> {
        self.resolve_preset(self.preset.as_deref().unwrap_or("tracking-mlp"))
    }

    /// The experiment of another preset with the same changes.
    ///
    /// # Errors
    /// See [`resolve`](Self::resolve).
    pub fn resolve_preset(&self, preset: &str) -> Result<Experiment> {
        let lockstep = self.lockstep.then_some(LOCKSTEP).into_iter().flatten().map(String::from);
        let device = self.device.map(|device| format!("learner.device=\"{device}\""));
        let overrides: Vec<String> = lockstep.chain(device).chain(self.overrides.iter().cloned()).collect();
        let experiment = comic_experiment::resolve(preset, &overrides)
            .map_err(Error::within(format!("the experiment `{preset}` cannot be used")))?;
        Ok(experiment.with_clips(&self.clips))
    }
}
