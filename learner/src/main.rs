//! The program `comic-learner`.

use std::io::{IsTerminal as _, Write as _};
use std::process::ExitCode;
use std::sync::Arc;

use clap::{CommandFactory as _, Parser as _};
use comic_learner::STOPPED;
use comic_learner::commands;
use comic_learner::error::{Error, Result};
use comic_learner::options::{Command, LogFormat, Options};
use comic_learner::train::parts::Ending;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::format::FmtSpan;

/// glibc's allocator does not reuse the memory that thousands of connections freed: under 4000 actors the learner grew by
/// 27 MB a minute, without end. With this allocator it stays at its size. docs/benchmarks.md has the figures.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    let options = Arc::new(Options::parse());
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
    // The exit code of a health check is 0 or 1, whatever the error is.
    if let Some(Command::Health(health)) = &options.command {
        return health.run();
    }
    match run(&options) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("comic-learner: {}", comic_proto::chain(&error));
            if error.is_disk_full() && options.command.is_none() {
                eprintln!(
                    "comic-learner: the checkpoints are not lost. Remove other files from the disk, for instance \
                     films/ and tensorboard/ of the run, and start again with the same --run"
                );
            }
            ExitCode::from(error.exit_code())
        }
    }
}

fn run(options: &Arc<Options>) -> Result<ExitCode> {
    match &options.command {
        Some(command) => run_command(command, options)?,
        None if options.print => comic_learner::run::print(options)?,
        None => {
            comic_learner::threads::prepare_libraries();
            if comic_learner::run::run(options)? == Ending::Stopped {
                return Ok(ExitCode::from(STOPPED));
            }
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn run_command(command: &Command, options: &Options) -> Result<()> {
    match command {
        Command::Export { checkpoint, part, out } => commands::export::run(checkpoint, *part, out),
        Command::Prior(prior) => prior.run(),
        Command::LowLevel(low_level) => low_level.run(),
        Command::Sizes => {
            let table = commands::sizes::table(&options.document)?;
            let written = std::io::stdout().write_all(table.as_bytes());
            written.map_err(|source| Error::System { what: "cannot write to stdout".into(), source })
        }
        Command::Status(status) => status.run(),
        Command::Health(_) => Ok(()),
        Command::Certs(certs) => certs.run(),
        Command::Metrics => comic_learner::observe::prometheus::print_reference(),
        Command::Manual(manual) => manual
            .write(Options::command())
            .map_err(|source| Error::System { what: "cannot write the manual".into(), source }),
    }
}
