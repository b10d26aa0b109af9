//! One learner epoch: resume a run or begin it, serve and train, end.

mod low_level;
mod opening;
mod prepare;

use std::io::Write as _;
use std::net::SocketAddr;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use comic_experiment::Experiment;
use comic_replay::Batcher;
use tempfile::TempDir;
use tokio::net::TcpListener;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::oneshot;

use crate::checkpoint::Store;
use crate::device::Backend;

use crate::error::{Error, Result};
use crate::exit_code::STOPPED;
use crate::meeting::Meeting;
use crate::observe::probes;
use crate::options::Options;
use crate::publish::Publisher;
use crate::security::Security;
use crate::service::process::{allow_descriptors, runtime};
use crate::service::{Service, serve};
use crate::threads;
use crate::train::parts::{Ending, TrainerParts};
use crate::train::trainer::Trainer;

/// File descriptors besides those of connections to actors.
const OTHER_FILES: u64 = 256;
/// How long the learner waits until actors have heard that the run is over.
const END_DELAY: Duration = Duration::from_millis(1500);
/// The same while an actor that was here lately is not connected: it waits up to five seconds before it tries again. An
/// evaluator does not join, so nobody waits for it; it has `--give-up-after`.
const ABSENT_END_DELAY: Duration = Duration::from_secs(7);
/// The same if the run was over before the learner started: actors then wait up to five seconds between two attempts to
/// connect.
const LATE_END_DELAY: Duration = Duration::from_secs(20);
/// How often the learner looks whether absent actors are back.
const POLL: Duration = Duration::from_millis(100);

/// Prints the resolved experiment.
///
/// # Errors
/// A wrong experiment, or a standard output that is closed.
pub fn print(options: &Options) -> Result<()> {
    let text = options.document.resolve()?.to_toml()?;
    std::io::stdout().write_all(text.as_bytes()).map_err(Error::system("cannot write to stdout"))
}

/// Serves and trains until the budget is used up or a signal comes, and returns which. Prints one JSON line to stdout when it
/// listens.
///
/// # Errors
/// A wrong experiment, unusable clips, a run directory of another experiment, an address in use, a disk that fails.
pub fn run(options: &Arc<Options>) -> Result<Ending> {
    let experiment = options.document.resolve()?;
    options.world.check(&experiment)?;
    tch::set_num_threads(threads::of(&experiment) as i32);
    runtime()?.block_on(serve_and_train(options, experiment))
}

async fn serve_and_train(options: &Arc<Options>, experiment: Experiment) -> Result<Ending> {
    // First, so that no signal is missed.
    let mut signals = Signals::new()?;
    let security = Security::new(&options.security, options.address)?;
    allow_descriptors(options.limits.max_connections() as u64 + OTHER_FILES);
    let listeners = Listeners::bind(options).await?;
    let open = || Store::open(&options.run, experiment.learner.checkpoints_kept);
    let store = (options.world.rank == 0).then(open).transpose()?;
    let _lock = store.as_ref().map(Store::lock).transpose()?;
    let begun = Begun { options: Arc::clone(options), experiment, security, store };
    let (parts, service, _scratch) = begin(begun, local_address(&listeners.actors)?, &mut signals).await?;
    let (batcher, publisher, epoch) = (parts.batcher.clone(), parts.publisher.clone(), parts.epoch);
    let trained_before = batcher.accounting().trained;
    let mut training = start_trainer(parts)?;
    listeners.announce(options, epoch)?;
    let (stop_serving, stopped) = oneshot::channel::<()>();
    let serving = tokio::spawn(serve(listeners.actors, service.clone(), async {
        let _ = stopped.await;
    }));
    if let Some(metrics) = listeners.metrics {
        tokio::spawn(probes::serve(metrics, service.probed()));
    }
    let ending = wait_for_end(&mut training, &mut signals, &service, &batcher).await;
    if let Ok(Ending::Budget) = &ending {
        let trained = batcher.accounting().trained > trained_before;
        let farewell = end_run(&publisher, &service, if trained { END_DELAY } else { LATE_END_DELAY });
        tokio::select! {
            () = farewell => {}
            () = signals.first() => {}
        }
    }
    batcher.close();
    let _ = stop_serving.send(());
    let served = serving.await;
    let ending = ending?;
    served.map_err(|_| Error::Panicked("the server"))??;
    tracing::info!(accounting = ?batcher.accounting(), "{}", match ending {
        Ending::Budget => "the budget is used up",
        Ending::Stopped if options.world.world_size > 1 => "stopped; start all ranks again to continue",
        Ending::Stopped => "stopped; start again with the same --run to continue",
    });
    Ok(ending)
}

/// What a learner epoch begins with.
struct Begun {
    options: Arc<Options>,
    experiment: Experiment,
    security: Security,
    store: Option<Store>,
}

/// The parts, the service, and the directory of what actors fetch, if it is not the run's.
type Parts = (TrainerParts, Service, Option<TempDir>);

/// Meets the other ranks and prepares the parts. With several ranks that may take minutes, in which a signal ends the process: nothing
/// has begun.
async fn begin(begun: Begun, serving: SocketAddr, signals: &mut Signals) -> Result<Parts> {
    if begun.options.world.world_size == 1 {
        return meet_and_prepare(begun, serving);
    }
    tokio::select! {
        parts = tokio::task::spawn_blocking(move || meet_and_prepare(begun, serving)) => {
            parts.map_err(|_| Error::Panicked("the thread that meets the other ranks"))?
        }
        () = signals.first() => {
            tracing::info!("told to stop before training began");
            signal_hook::low_level::exit(STOPPED.into())
        }
    }
}

fn meet_and_prepare(begun: Begun, serving: SocketAddr) -> Result<Parts> {
    let Begun { options, experiment, security, store } = begun;
    let meeting = Meeting::hold(&options.world, serving)?;
    // Only the learner that has the run takes the device.
    let backend = Backend::open(&experiment.learner)?;
    // Another rank than the first keeps what its actors fetch only as long as it runs.
    let scratch = || tempfile::Builder::new().prefix("comic-learner-").tempdir();
    let scratch = store.is_none().then(scratch).transpose();
    let scratch = scratch.map_err(Error::system("there is no directory for temporary files: set TMPDIR"))?;
    let files = scratch.as_ref().map_or_else(|| options.run.clone(), |scratch| scratch.path().to_path_buf());
    let (parts, service) = prepare::prepare(&options, experiment, backend, security, store, &files, meeting)?;
    Ok((parts, service, scratch))
}

/// Tells the actors that the run is over, and gives them this time to hear it, and more if one is away.
async fn end_run(publisher: &Publisher, service: &Service, delay: Duration) {
    if publisher.newest().is_some() {
        let (begun, mut absent) = (Instant::now(), service.absent());
        publisher.end_run();
        tokio::time::sleep(delay).await;
        while absent.remain() && begun.elapsed() < ABSENT_END_DELAY {
            tokio::time::sleep(POLL).await;
        }
        // The one that has just come hears it, too.
        tokio::time::sleep(POLL).await;
    }
}

/// The signals that stop a learner.
struct Signals {
    interrupt: Signal,
    terminate: Signal,
    hangup: Signal,
}

impl Signals {
    fn new() -> Result<Self> {
        let listen = |kind| signal(kind).map_err(Error::system("cannot wait for signals"));
        Ok(Self {
            interrupt: listen(SignalKind::interrupt())?,
            terminate: listen(SignalKind::terminate())?,
            hangup: listen(SignalKind::hangup())?,
        })
    }

    async fn first(&mut self) {
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
            _ = self.hangup.recv() => {}
        }
    }

    /// A second signal; a hangup does not count.
    async fn second(&mut self) {
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
        }
    }
}

/// Waits until training ends, and returns the trainer's result. The first signal asks the trainer to stop after its update,
/// and the second one ends the process.
async fn wait_for_end(
    training: &mut Training,
    signals: &mut Signals,
    service: &Service,
    batcher: &Batcher,
) -> Result<Ending> {
    let ending = tokio::select! {
        ending = &mut *training => ending,
        () = signals.first() => {
            tracing::info!("stopping after this update; a checkpoint follows. A second signal stops at once, without it");
            service.drain();
            batcher.close();
            tokio::select! {
                ending = training => ending,
                () = signals.second() => end_the_process(),
            }
        }
    };
    ending.unwrap_or(Err(Error::Panicked("the trainer")))
}

/// Ends the process at once. The trainer may be inside libtorch, which must not be destroyed meanwhile, so nothing is.
fn end_the_process() -> ! {
    let error = Error::Stopped;
    tracing::error!("{error}");
    signal_hook::low_level::exit(error.exit_code().into())
}

/// The sockets that a learner listens on.
struct Listeners {
    actors: TcpListener,
    metrics: Option<TcpListener>,
}

impl Listeners {
    async fn bind(options: &Options) -> Result<Self> {
        let actors = listen(options, "port", options.port).await?;
        let metrics = match options.metrics_port {
            Some(port) => Some(listen(options, "metrics-port", port).await?),
            None => None,
        };
        Ok(Self { actors, metrics })
    }

    /// Prints the JSON line that says where the learner listens.
    fn announce(&self, options: &Options, epoch: u64) -> Result<()> {
        let address = local_address(&self.actors)?;
        let mut line = serde_json::json!({ "listening": address.to_string(), "learner_epoch": epoch });
        match options.world.rank {
            0 => line["run"] = serde_json::json!(options.run),
            rank => line["rank"] = rank.into(),
        }
        if let Some(metrics) = &self.metrics {
            line["metrics"] = local_address(metrics)?.to_string().into();
        }
        // An error is not important: stdout may be closed.
        let _ = writeln!(std::io::stdout(), "{line}");
        let rank = options.world.rank;
        // Only rank 0 has the run.
        let run = (rank == 0).then(|| options.run.display()).map(tracing::field::display);
        tracing::info!(%address, epoch, rank, run, "serving");
        Ok(())
    }
}

async fn listen(options: &Options, flag: &str, port: u16) -> Result<TcpListener> {
    let address = SocketAddr::new(options.address, port);
    let failed = format!("cannot listen on {address}: choose another --{flag}, or 0 for any free one");
    TcpListener::bind(address).await.map_err(Error::system(failed))
}

fn local_address(listener: &TcpListener) -> Result<SocketAddr> {
    listener.local_addr().map_err(Error::system("a socket has no address"))
}

/// The end of the trainer's thread.
type Training = oneshot::Receiver<Result<Ending>>;

fn start_trainer(parts: TrainerParts) -> Result<Training> {
    let (ended, training) = oneshot::channel();
    std::thread::Builder::new()
        .name("trainer".into())
        .spawn(move || {
            let ending = catch_unwind(AssertUnwindSafe(|| Trainer::new(parts)?.run()));
            let _ = ended.send(ending.unwrap_or(Err(Error::Panicked("the trainer"))));
        })
        .map_err(Error::system("cannot start the trainer's thread"))?;
    Ok(training)
}
