//! The command line.

use std::path::PathBuf;

use clap::{Parser, Subcommand, ValueEnum};
use comic_manual::Manual;
use comic_networks::export::Part;

use crate::commands::certs::Certs;
use crate::commands::health::Health;
use crate::commands::low_level::LowLevel;
use crate::commands::prior::Prior;
use crate::commands::status::Status;
use crate::document::DocumentArguments;
use crate::meeting::WorldArguments;
use crate::security::{ConnectionLimits, SecurityArguments};
use crate::service::quarantine::QuarantineArguments;

/// Learns reusable motor skills from the experience that comic-actor processes stream to it.
#[derive(Debug, Parser)]
#[command(name = "comic-learner", version, about, after_help = EXIT_CODES)]
pub struct Options {
    /// What to do instead of serving and training.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// What to learn.
    #[command(flatten)]
    pub document: DocumentArguments,
    /// Port to serve on; 0 lets the system choose.
    #[arg(long, default_value_t = 7070)]
    pub port: u16,
    /// Address to serve on. An address that other machines can reach (0.0.0.0) needs TLS, a token, or --insecure.
    #[arg(long, default_value = "127.0.0.1")]
    pub address: std::net::IpAddr,
    /// Port on the same address for /metrics, /healthz and /readyz over HTTP; 0 lets the system choose [default: none].
    #[arg(long, value_name = "PORT")]
    pub metrics_port: Option<u16>,
    /// Who may use the learner.
    #[command(flatten)]
    pub security: SecurityArguments,
    /// How many may use the learner.
    #[command(flatten)]
    pub limits: ConnectionLimits,
    /// What to do with invalid unrolls.
    #[command(flatten)]
    pub quarantine: QuarantineArguments,
    /// Several learners.
    #[command(flatten)]
    pub world: WorldArguments,
    /// The run's directory: checkpoints, metrics.jsonl, tensorboard, the resolved experiment. If it holds checkpoints, the run
    /// is resumed.
    #[arg(long, value_name = "DIR", default_value = "runs/default")]
    pub run: PathBuf,
    /// Resume a run although its experiment was different, as far as its checkpoint fits.
    #[arg(long)]
    pub allow_changed: bool,
    /// Print the resolved experiment and exit.
    #[arg(long)]
    pub print: bool,
    /// Format of the log on stderr.
    #[arg(long, value_enum, default_value_t = LogFormat::Text, global = true)]
    pub log_format: LogFormat,
}

/// What to do instead of serving and training.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Write a checkpoint's policy, or a part of it, to a file that evaluations, transfer and other programs can read.
    Export {
        /// A run's directory, its `checkpoints`, or one checkpoint; the newest complete one is exported.
        #[arg(long, value_name = "DIR")]
        checkpoint: PathBuf,
        /// policy (everything that acts, for all tasks), policy:TASK (for one task), encoder:TASK, or low-level.
        #[arg(long)]
        part: Part,
        /// The file: NAME.safetensors; or, for a policy of one task, NAME.pt for TorchScript or NAME.onnx for ONNX.
        #[arg(long, value_name = "FILE")]
        out: PathBuf,
    },
    /// Fit the prior of a low level's latents, for a transfer with `transfer.prior = "state"`.
    Prior(Prior),
    /// Print the card of a low level: what it was learned from, how well, and how it is made again.
    LowLevel(LowLevel),
    /// Print how many parameters the networks of the paper's presets have, or those of --preset and --set.
    Sizes,
    /// Print the state of a running learner.
    Status(Status),
    /// Exit with 0 if a learner serves and with 1 if not, for a container's health check.
    Health(Health),
    /// Make a certificate authority for development, and certificates for a learner and its actors.
    Certs(Certs),
    /// Print what each metric means, as in docs/metrics.md.
    Metrics,
    /// Write shell completions and man pages.
    #[command(hide = true)]
    Manual(Manual),
}

/// `docs/running.md` says more, and has the actor's.
const EXIT_CODES: &str = "\
Exit codes: 0 when the run is over; 4 when the learner was told to stop before that and wrote its checkpoint; 5 when another
learner of the run was lost; 2 when the configuration is wrong, so that starting again cannot help; 1 otherwise.
Logs go to standard error; RUST_LOG sets their level (default: info).";

/// Format of the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// Plain text.
    Text,
    /// One JSON object per line.
    Json,
}
