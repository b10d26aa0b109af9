//! The command line.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use comic_experiment::{DeviceName, Experiment};
use comic_networks::export::Part;

use crate::commands::certs::Certs;
use crate::commands::health::Health;
use crate::commands::status::Status;
use crate::error::{Error, Result};
use crate::security::{ConnectionLimits, SecurityOptions};
use crate::service::quarantine::QuarantineOptions;

/// Learns reusable motor skills from the experience that comic-actor processes stream to it.
#[derive(Debug, Parser)]
#[command(name = "comic-learner", version, about, after_help = EXIT_CODES)]
pub struct Options {
    /// What else than serving.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// What to learn.
    #[command(flatten)]
    pub document: Document,
    /// Port to serve on; 0 lets the system choose.
    #[arg(long, default_value_t = 7070)]
    pub port: u16,
    /// Address to serve on. Beyond this machine (0.0.0.0) it wants TLS, a token, or --insecure.
    #[arg(long, default_value = "127.0.0.1")]
    pub address: std::net::IpAddr,
    /// Port on the same address for /metrics, /healthz and /readyz over HTTP; none unless given, 0 lets the system choose.
    #[arg(long, value_name = "PORT")]
    pub metrics_port: Option<u16>,
    /// Who gets in.
    #[command(flatten)]
    pub security: SecurityOptions,
    /// How many get in.
    #[command(flatten)]
    pub limits: ConnectionLimits,
    /// What becomes of invalid unrolls.
    #[command(flatten)]
    pub quarantine: QuarantineOptions,
    /// The run's directory: checkpoints, metrics.jsonl, tensorboard, the resolved experiment. A directory that holds checkpoints is
    /// resumed.
    #[arg(long, value_name = "DIR", default_value = "runs/default")]
    pub run: PathBuf,
    /// Go on with a run whose experiment was another one, as far as its checkpoint fits.
    #[arg(long)]
    pub allow_changed: bool,
    /// Print the resolved experiment and leave.
    #[arg(long)]
    pub print: bool,
    /// Form of the log on stderr.
    #[arg(long, value_enum, default_value_t = LogFormat::Text, global = true)]
    pub log_format: LogFormat,
}

/// The experiment and what changes it.
#[derive(Clone, Debug, Args)]
pub struct Document {
    /// A preset's name, as README lists them, or the path of an experiment file [default: tracking-mlp].
    #[arg(long, value_name = "NAME|FILE", global = true)]
    pub preset: Option<String>,
    /// Clips to track instead of the experiment's: builtin:NAME, FILE.h5, FILE.h5#SUBSET or FILE.h5#CLIP,CLIP.
    #[arg(long, value_name = "SOURCE", num_args = 1.., global = true)]
    pub clips: Vec<String>,
    /// Override any field, for instance --set vmpo.epsilon_eta=0.2.
    #[arg(long = "set", value_name = "FIELD=VALUE", global = true)]
    pub overrides: Vec<String>,
    /// Where the update runs: cpu, cuda[:N] or xla[:N]; short for --set learner.device=D.
    #[arg(long, value_name = "DEVICE", global = true)]
    pub device: Option<DeviceName>,
    /// Learn reproducibly, whatever actors there are, for debugging; short for --set unroll.lockstep=true and --set
    /// unroll.ahead=0.
    #[arg(long, global = true)]
    pub lockstep: bool,
}

/// What `--lockstep` stands for; `--set` has the last word.
const LOCKSTEP: [&str; 2] = ["unroll.lockstep=true", "unroll.ahead=0"];

impl Document {
    /// The resolved experiment.
    ///
    /// # Errors
    /// Names the file, field and remedy.
    pub fn resolve(&self) -> Result<Experiment> {
        self.resolve_preset(self.preset.as_deref().unwrap_or("tracking-mlp"))
    }

    /// The experiment of another name with the same changes.
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

/// What else than serving.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Write a checkpoint's policy, or a part of it, as a file that evaluations, transfer and other programs read.
    Export {
        /// A run's directory, its `checkpoints`, or one checkpoint; the newest complete one is taken.
        #[arg(long, value_name = "DIR")]
        checkpoint: PathBuf,
        /// policy: everything that acts, of all tasks or of one (policy:TASK); encoder:TASK; or low-level.
        #[arg(long)]
        part: Part,
        /// The file, .safetensors; .pt is a policy of one task as TorchScript.
        #[arg(long, value_name = "FILE")]
        out: PathBuf,
    },
    /// Print how many parameters the networks have: those of the paper's presets, or of --preset, with --set.
    Sizes,
    /// Print the state of a running learner.
    Status(Status),
    /// Exit with 0 if a learner serves and with 1 if not, for a container's health check.
    Health(Health),
    /// Make a development authority, and certificates for a learner and its actors.
    Certs(Certs),
    /// Print what each metric means, as docs/metrics.md has it.
    Metrics,
}

/// The same on both sides; `docs/operations.md` says more.
const EXIT_CODES: &str = "\
Exit codes: 0 when the run is over or the learner was told to stop and wrote its checkpoint, 2 when the configuration
is wrong and starting again cannot help, 1 otherwise.
Logs go to standard error; RUST_LOG chooses what (default: info).";

/// Form of the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// For a person.
    Text,
    /// One JSON object a line.
    Json,
}
