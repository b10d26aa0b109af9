//! An actor process: joins, builds the environments, and acts until the run is over or it is told to stop.

use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

use comic_clips::Catalogue;
use comic_proto::Access;
use tokio::runtime::Runtime;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::{mpsc, watch};

use crate::Error;
use crate::dump::{Dumps, Watched};
use crate::forward_pass::{ForwardPass, OneByOne};
use crate::liveness::Liveness;
use crate::mailbox::Mailbox;
use crate::policy::TorchPolicy;
use crate::seeds::EnvironmentSeeds;
use crate::session::{self, ExchangeLimits, Joined};
use crate::worker::{FinishedUnroll, Pace, Progress, Worker};

/// How long a stopped actor sends finished unrolls. It promises to exit within five seconds; this is one second less.
const FLUSH: Duration = Duration::from_secs(4);
/// Most unrolls without acknowledgement: two for each environment, within these limits. Half as many may wait between the
/// workers and the connection.
const FEWEST_UNACKNOWLEDGED: usize = 4;
const MOST_UNACKNOWLEDGED: usize = 256;
/// Names, shapes and alignment may make the learner's safetensors document a little larger than this actor's.
const PARAMETERS_SLACK: u64 = 1 << 16;
const LOG_EVERY: Duration = Duration::from_secs(10);

/// The command line of `comic-actor` without a subcommand.
#[derive(Clone, Debug)]
pub struct Options {
    /// For instance `http://host:7070`.
    pub learner: String,
    /// Certificates and token.
    pub access: Access,
    /// A name that stays the same over restarts, if this actor has one.
    pub name: Option<String>,
    /// Threads; the experiment's number when absent.
    pub threads: Option<usize>,
    /// Environments a thread; the experiment's number when absent.
    pub environments: Option<usize>,
    /// Directory of the asset cache; the user's cache directory when absent.
    pub cache: Option<PathBuf>,
    /// How long to go on while the learner does not answer; for ever when absent.
    pub give_up_after: Option<Duration>,
    /// Directory for episodes that diverged, if they are kept.
    pub dump_diverged: Option<PathBuf>,
    /// File that is written while environments are stepped, for a health check.
    pub liveness: Option<PathBuf>,
}

type TaskWorker = Worker<Watched, Box<dyn ForwardPass + Send>>;

/// Acts for a learner until the run is over.
///
/// # Errors
/// [`Error::Stopped`] when the process was told to stop before that (SIGTERM, SIGINT, SIGHUP) and has sent its finished
/// unrolls, and [`Error::GaveUp`]. A lost connection is no error.
pub fn run(options: &Options) -> Result<(), Error> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .thread_name("session")
        .enable_all()
        .build()
        .map_err(Error::Thread)?;
    let outcome = act(&runtime, options);
    // A slow name resolution blocks a thread of the runtime. It must not block the exit.
    runtime.shutdown_background();
    outcome
}

fn act(runtime: &Runtime, options: &Options) -> Result<(), Error> {
    let liveness = options.liveness.as_deref().map(Liveness::new).transpose()?;
    let mailbox = Arc::new(Mailbox::default());
    let (stopping, stop) = watch::channel(false);
    let closing = Closing { mailbox: Arc::clone(&mailbox), stopping };
    stop_on_signal(runtime, closing.clone())?;
    let session = session::JoinSettings {
        learner: options.learner.clone(),
        access: options.access.clone(),
        cache: options.cache.clone(),
        name: options.name.clone(),
        threads: options.threads,
        environments: options.environments,
        give_up_after: options.give_up_after,
    };
    let joined = runtime.block_on(session::join(&session, stop.clone()))?;
    let threads = options.threads.unwrap_or(joined.experiment.actor.threads).max(1);
    let environments = options.environments.unwrap_or(joined.experiment.actor.environments).max(1);
    let (pace, numbers) = match &joined.environments {
        Some(share) => (Pace::Lockstep, share.clone()),
        None => (Pace::Free, 0..u32::try_from(threads.saturating_mul(environments)).unwrap_or(u32::MAX)),
    };
    let environments = numbers.len();
    let dumps = options.dump_diverged.as_deref();
    let dumps = dumps.map(|directory| Dumps::new(directory, &joined.experiment, &joined.spec)).transpose()?;
    let (workers, parameters) = build(&joined, threads, pace, numbers, dumps.as_ref())?;
    tracing::info!(experiment = joined.experiment.name, threads = workers.len(), environments, ?pace, "acting");

    let unacknowledged = environments.saturating_mul(2).clamp(FEWEST_UNACKNOWLEDGED, MOST_UNACKNOWLEDGED);
    let limits = ExchangeLimits { window: unacknowledged, parameters: parameters + PARAMETERS_SLACK, flush: FLUSH };
    // One round of unrolls fits, so a worker continues to step while the connection takes its unrolls.
    let (sender, unrolls) = mpsc::channel(unacknowledged / 2);
    let progress = Arc::new(Progress::default());
    let session = runtime.spawn(joined.run(limits, unrolls, Arc::clone(&mailbox), stop));
    let reporter = runtime.spawn(report(Arc::clone(&progress)));
    let liveness = liveness.map(|liveness| runtime.spawn(liveness.keep_up(Arc::clone(&progress))));

    let handles = start(workers, pace, &closing, sender, &progress)?;
    let settled = runtime.block_on(session);
    mailbox.close();
    reporter.abort();
    if let Some(liveness) = liveness {
        liveness.abort();
    }
    for handle in handles {
        handle.join().map_err(|_| Error::WorkerPanicked)??;
    }
    let settled = settled.map_err(|_| Error::WorkerPanicked)??;
    tracing::info!(steps = progress.steps.load(Ordering::Relaxed), ?settled, "exiting");
    // Exit code 0 means that the run is over: a Kubernetes Job counts it as completed.
    if settled.over { Ok(()) } else { Err(Error::Stopped) }
}

/// Stops everything at SIGTERM, SIGINT or SIGHUP.
fn stop_on_signal(runtime: &Runtime, closing: Closing) -> Result<(), Error> {
    let _context = runtime.enter();
    let mut terminate = signal(SignalKind::terminate()).map_err(Error::Thread)?;
    let mut interrupt = signal(SignalKind::interrupt()).map_err(Error::Thread)?;
    let mut hangup = signal(SignalKind::hangup()).map_err(Error::Thread)?;
    runtime.spawn(async move {
        tokio::select! {
            _ = terminate.recv() => {}
            _ = interrupt.recv() => {}
            _ = hangup.recv() => {}
        }
        tracing::info!("told to stop: sending the finished unrolls");
        drop(closing);
    });
    Ok(())
}

/// The workers, at most one a thread, and the bytes of the policy's parameters.
fn build(
    joined: &Joined,
    threads: usize,
    pace: Pace,
    numbers: Range<u32>,
    dumps: Option<&Arc<Dumps>>,
) -> Result<(Vec<TaskWorker>, u64), Error> {
    let (experiment, spec) = (&joined.experiment, &joined.spec);
    let catalogue = Catalogue::open_with(&experiment.clips, |source| joined.assets.get(source).cloned())?;
    let task = comic_tasks::build(experiment, &catalogue)?;
    if task.spec() != spec {
        return Err(Error::Disagreement { what: "the task's observations, rewards or clips" });
    }
    let low_level = joined.low_level()?;
    let mut parameters = 0;
    let mut workers = Vec::with_capacity(threads);
    let each = numbers.len().div_ceil(threads);
    for first in numbers.clone().step_by(each) {
        let environments = (first..numbers.end)
            .take(each)
            .map(|number| {
                let seed = EnvironmentSeeds::new(joined.seed, number).simulation;
                Ok(Watched::new(Arc::clone(&task).environment(seed)?, dumps.cloned(), seed))
            })
            .collect::<Result<_, comic_tasks::Error>>()?;
        // The first parameters from the learner replace the initial ones.
        let policy = TorchPolicy::untrained(spec, experiment, low_level.as_deref(), 0, || Ok([0.0; 56]))?;
        parameters = policy.to_parameters()?.len() as u64;
        let policy: Box<dyn ForwardPass + Send> = match pace {
            Pace::Free => Box::new(policy),
            Pace::Lockstep => Box::new(OneByOne::new(policy, joined.layout.shape())),
        };
        workers.push(Worker::new(environments, policy, Arc::clone(&joined.layout), first, joined.seed)?);
    }
    Ok((workers, parameters))
}

type WorkerThread = thread::JoinHandle<Result<(), Error>>;

fn start(
    workers: Vec<TaskWorker>,
    pace: Pace,
    closing: &Closing,
    unrolls: mpsc::Sender<FinishedUnroll>,
    progress: &Arc<Progress>,
) -> Result<Vec<WorkerThread>, Error> {
    workers
        .into_iter()
        .enumerate()
        .map(|(index, worker)| {
            let (closing, unrolls, progress) = (closing.clone(), unrolls.clone(), Arc::clone(progress));
            thread::Builder::new()
                .name(format!("worker-{index}"))
                .spawn(move || {
                    let closing = closing;
                    worker.run(pace, &closing.mailbox, &unrolls, &progress)
                })
                .map_err(Error::Thread)
        })
        .collect()
}

/// When it is dropped, it stops the workers after their current step and the session after its flush. Every worker holds
/// one, so that an error or a panic of one worker stops all others.
#[derive(Clone)]
struct Closing {
    mailbox: Arc<Mailbox>,
    stopping: watch::Sender<bool>,
}

impl Drop for Closing {
    fn drop(&mut self) {
        self.mailbox.close();
        self.stopping.send_replace(true);
    }
}

async fn report(progress: Arc<Progress>) {
    let mut last = (Instant::now(), 0);
    loop {
        tokio::time::sleep(LOG_EVERY).await;
        let steps = progress.steps.load(Ordering::Relaxed);
        let rate = (steps - last.1) as f64 / last.0.elapsed().as_secs_f64();
        let episodes = progress.episodes.load(Ordering::Relaxed);
        tracing::info!(steps, episodes, steps_per_second = rate.round(), "acting");
        last = (Instant::now(), steps);
    }
}
