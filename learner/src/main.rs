//! The program `comic-learner`.

use std::io::{IsTerminal as _, Write as _};
use std::process::ExitCode;

use anyhow::Context as _;
use clap::Parser as _;
use comic_learner::error::Misuse;
use comic_learner::options::{Command, LogFormat, Options};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::format::FmtSpan;

/// glibc's allocator keeps what thousands of connections gave back: under 4000 actors the learner grew without end, by 27 MB
/// a minute at 1.8 GB, and with this one it stays. docs/operations.md has the figures.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    let options = Options::parse();
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    let log = tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .with_span_events(FmtSpan::CLOSE)
        .with_env_filter(filter);
    match options.log_format {
        LogFormat::Text => log.init(),
        LogFormat::Json => log.json().init(),
    }
    let ended = match &options.command {
        Some(Command::Export { checkpoint, part, out }) => comic_learner::commands::export::run(checkpoint, *part, out),
        Some(Command::Sizes) => comic_learner::commands::sizes::table(&options.document)
            .and_then(|table| std::io::stdout().write_all(table.as_bytes()).context("cannot write to stdout")),
        Some(Command::Status(status)) => status.run(),
        Some(Command::Health(health)) => return health.run(),
        Some(Command::Certs(certs)) => certs.run(),
        Some(Command::Metrics) => comic_learner::observe::telemetry::print_reference(),
        None => comic_learner::run::run(&options),
    };
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("comic-learner: {error:#}");
            // A configuration that is wrong stays wrong: 2 tells whoever restarts processes not to try again.
            let configuration = error.chain().any(|cause| {
                cause.is::<comic_experiment::Error>()
                    || cause.is::<comic_clips::Error>()
                    || cause.is::<comic_proto::AccessError>()
                    || cause.is::<Misuse>()
            });
            ExitCode::from(if configuration { 2 } else { 1 })
        }
    }
}
