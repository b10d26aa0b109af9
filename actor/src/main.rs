//! The `comic-actor` program.

use std::io::IsTerminal as _;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context as _;
use clap::{Args, CommandFactory as _, Parser, Subcommand, ValueEnum};
use comic_actor::assess::Assess;
use comic_actor::clips::Clips;
use comic_actor::dump;
use comic_actor::evaluate::command::Evaluate;
use comic_actor::latents::Latents;
use comic_actor::liveness::Health;
use comic_actor::render::command::Render;
use comic_actor::render::view::View;
use comic_actor::{Error, policy, run};
use comic_manual::Manual;
use comic_proto::Access;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::format::FmtSpan;

const EXIT_CODES: &str = "\
Exit codes: 0 when the run is over, 2 when the configuration is wrong and starting again cannot help (a token or a
certificate that is not accepted, another release), 3 when the learner did not answer for the time of --give-up-after, 1
otherwise (told to stop before the run was over, or the learner now serves another experiment).
Logs go to standard error; RUST_LOG chooses what (default: info).";

/// Steps humanoids for a learner; it needs only the learner's address.
#[derive(Debug, Parser)]
#[command(version, args_conflicts_with_subcommands = true, after_help = EXIT_CODES)]
struct Arguments {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    act: Act,
    /// How log lines are written.
    #[arg(long, value_enum, default_value_t = LogFormat::Text, global = true)]
    log_format: LogFormat,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Evaluates a policy, per clip and reward term.
    Evaluate(Evaluate),
    /// Writes latents of a policy's encoder, to which `comic-learner prior` fits a prior.
    Latents(Latents),
    /// Measures how long a low level stays upright and how far it walks with random latents, before anything is learned.
    Assess(Assess),
    /// Films a policy at work; needs no display.
    Render(Render),
    /// Shows a policy at work in a window.
    View(View),
    /// Lists, checks, imports, merges and fetches motion capture.
    Clips(Clips),
    /// Plays a diverged episode again that --dump-diverged wrote.
    Reproduce(dump::Command),
    /// Exits with 0 if an actor steps environments and with 1 if not, for a container's health check.
    Health(Health),
    /// Write shell completions and man pages.
    #[command(hide = true)]
    Manual(Manual),
}

#[derive(Args, Debug)]
struct Act {
    /// The learner's address, for instance http://host:7070 or https://host:7070.
    #[arg(long, value_name = "URL", env = "COMIC_LEARNER")]
    learner: Option<String>,
    #[command(flatten)]
    access: Access,
    /// A name that stays the same over restarts, such as a pod's index. A newer process of the same name replaces the
    /// older one. No name unless given.
    #[arg(long, value_name = "NAME", env = "COMIC_ACTOR_NAME")]
    name: Option<String>,
    /// Threads; the experiment's number unless given.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// Environments a thread; the experiment's number unless given.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=4096))]
    environments: Option<u16>,
    /// Where files from the learner are kept; `comic` in the user's cache directory unless given.
    #[arg(long, value_name = "DIR", env = "COMIC_CACHE")]
    cache: Option<PathBuf>,
    /// End with exit code 3 when the learner has not answered for so long. Never unless given.
    #[arg(long, value_name = "SECONDS", env = "COMIC_GIVE_UP_AFTER")]
    #[arg(value_parser = clap::value_parser!(u32).range(1..))]
    give_up_after: Option<u32>,
    /// Write episodes whose simulation diverged into this directory, at most 16; see `comic-actor reproduce`.
    #[arg(long, value_name = "DIR")]
    dump_diverged: Option<PathBuf>,
    /// Write this file while environments are stepped; see `comic-actor health`.
    #[arg(long, value_name = "FILE", env = "COMIC_LIVENESS")]
    liveness: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum LogFormat {
    Text,
    Json,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    start_logging(arguments.log_format);
    policy::use_one_torch_thread();
    match command(arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let known = error.downcast_ref::<Error>();
            match known {
                Some(stopped @ Error::Stopped) => tracing::info!("{stopped}"),
                _ => tracing::error!("{error:#}"),
            }
            ExitCode::from(known.map_or(1, Error::exit_code))
        }
    }
}

fn command(arguments: Arguments) -> anyhow::Result<()> {
    match arguments.command {
        Some(Command::Evaluate(evaluate)) => evaluate.run().context("cannot evaluate"),
        Some(Command::Latents(latents)) => latents.run().context("cannot collect latents"),
        Some(Command::Assess(assess)) => assess.run().context("cannot assess"),
        Some(Command::Render(render)) => render.run().context("cannot film"),
        Some(Command::View(view)) => view.run().context("cannot show"),
        Some(Command::Clips(clips)) => clips.run().map_err(anyhow::Error::from),
        Some(Command::Reproduce(reproduce)) => reproduce.run().context("cannot reproduce the episode"),
        Some(Command::Health(health)) => health.run(),
        Some(Command::Manual(manual)) => manual.write(Arguments::command()).context("cannot write the manual"),
        None => {
            let Act { learner, access, name, threads, environments, cache, give_up_after, dump_diverged, liveness } =
                arguments.act;
            let learner = learner.ok_or_else(|| {
                Error::Usage("no learner: give its address with --learner http://host:7070, or see --help".into())
            })?;
            let (threads, environments) = (threads.map(usize::from), environments.map(usize::from));
            let give_up_after = give_up_after.map(|seconds| Duration::from_secs(seconds.into()));
            let options = run::Options {
                learner,
                access,
                name,
                threads,
                environments,
                cache,
                give_up_after,
                dump_diverged,
                liveness,
            };
            run::run(&options).context("cannot act")
        }
    }
}

fn start_logging(format: LogFormat) {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    let builder = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_span_events(FmtSpan::CLOSE)
        .with_ansi(std::io::stderr().is_terminal());
    match format {
        LogFormat::Text => builder.with_target(false).init(),
        LogFormat::Json => builder.json().init(),
    }
}
