//! A learner's life: resume or begin, serve and train, end.

use std::io::Write as _;
use std::net::SocketAddr;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Duration;

use comic_clips::Catalogue;
use comic_experiment::{Difference, Experiment, InitialPose, TaskSpec, Unroll};
use comic_proto::{UnrollLayout, UnrollShape};
use comic_replay::{BatchOrder, Batcher, Config, Ledger, Phase};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::oneshot;

use crate::checkpoint::{Snapshot, Store, incompatible};
use crate::device::Backend;
use crate::error::{Error, Result};
use crate::observe::probes;
use crate::options::Options;
use crate::publish::Publisher;
use crate::security::Security;
use crate::service::{self, Shared};
use crate::train::trainer::{Ending, Setup, Trainer};

/// File descriptors for everything that is no connection to an actor.
const OTHER_FILES: u64 = 256;
/// How long actors are given to hear that the run is over.
const FAREWELL: Duration = Duration::from_millis(1500);
/// The same where it was over already: actors are on their way, and wait for up to five seconds between two attempts.
const LATE_FAREWELL: Duration = Duration::from_secs(20);

/// Serves and trains until the budget is used up or a signal comes. Prints one JSON line to stdout once it listens.
///
/// # Errors
/// A wrong experiment, unusable clips, a run directory of another experiment, an address in use, a disk that refuses.
pub fn run(options: &Options) -> Result<()> {
    let experiment = options.document.resolve()?;
    if options.print {
        let text = experiment.to_toml()?;
        return std::io::stdout().write_all(text.as_bytes()).map_err(Error::system("cannot write to stdout"));
    }
    tch::set_num_threads(experiment.learner.threads as i32);
    service_runtime()?.block_on(live(options, experiment))
}

/// The threads that serve.
///
/// # Errors
/// When the system starts no more threads.
pub fn service_runtime() -> Result<Runtime> {
    let workers = std::thread::available_parallelism().map_or(2, usize::from).clamp(1, 4);
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(workers)
        .enable_all()
        .build()
        .map_err(Error::system("cannot start tokio"))
}

async fn live(options: &Options, experiment: Experiment) -> Result<()> {
    // Both signals count from the first moment on.
    let listen_to = |kind| signal(kind).map_err(Error::system("cannot wait for signals"));
    let mut interrupt = listen_to(SignalKind::interrupt())?;
    let mut terminate = listen_to(SignalKind::terminate())?;
    let mut hangup = listen_to(SignalKind::hangup())?;
    let security = Security::new(&options.security, options.address)?;
    allow_descriptors(options.limits.max_connections() as u64 + OTHER_FILES);
    let listener = listen(options, "port", options.port).await?;
    let metrics = match options.metrics_port {
        Some(port) => Some(listen(options, "metrics-port", port).await?),
        None => None,
    };
    let _lock = Store::open(&options.run, experiment.learner.checkpoints_kept)?.lock()?;
    // Nothing else runs yet that this could hold up, and a device is taken by whoever has the run.
    let backend = Backend::open(&experiment.learner)?;
    let (setup, shared) = prepare(options, experiment, backend, security)?;
    let (batcher, publisher, epoch) = (setup.batcher.clone(), setup.publisher.clone(), setup.epoch);
    let began = batcher.accounting().trained;
    let mut training = start_trainer(setup)?;
    let (stop_serving, stopped) = oneshot::channel::<()>();
    let local_address =
        |listener: &TcpListener| listener.local_addr().map_err(Error::system("a socket has no address"));
    let address = local_address(&listener)?;
    let mut listening =
        serde_json::json!({ "listening": address.to_string(), "learner_epoch": epoch, "run": options.run });
    if let Some(metrics) = metrics {
        listening["metrics"] = local_address(&metrics)?.to_string().into();
        tokio::spawn(probes::serve(metrics, shared.clone()));
    }
    let serving = tokio::spawn(service::serve(listener, shared.clone(), async {
        let _ = stopped.await;
    }));
    // Nobody has to read it.
    let _ = writeln!(std::io::stdout(), "{listening}");
    tracing::info!(%address, epoch, run = %options.run.display(), "serving");
    let ending = tokio::select! {
        ending = &mut training => Some(ending),
        _ = interrupt.recv() => None,
        _ = terminate.recv() => None,
        _ = hangup.recv() => None,
    };
    let ending = match ending {
        Some(ending) => ending,
        None => {
            tracing::info!("stopping after this update; a checkpoint follows. A second signal does not wait for it");
            shared.drain();
            batcher.close();
            tokio::select! {
                ending = &mut training => ending,
                _ = interrupt.recv() => return Err(Error::Stopped),
                _ = terminate.recv() => return Err(Error::Stopped),
            }
        }
    };
    if let Ok(Ok(Ending::Budget)) = &ending
        && publisher.newest().is_some()
    {
        publisher.end_run();
        let trained = batcher.accounting().trained > began;
        tokio::time::sleep(if trained { FAREWELL } else { LATE_FAREWELL }).await;
    }
    batcher.close();
    let _ = stop_serving.send(());
    let served = serving.await;
    let ending = ending.map_err(|_| Error::Panicked("the trainer"))??;
    served.map_err(|_| Error::Panicked("the server"))??;
    tracing::info!(accounting = ?batcher.accounting(), "{}", match ending {
        Ending::Budget => "the budget is used up",
        Ending::Stopped => "stopped; start again with the same --run to go on",
    });
    Ok(())
}

/// A connection is a file descriptor, and systems give 1024 unless asked for more.
pub fn allow_descriptors(wanted: u64) {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    if current.is_none_or(|current| current >= wanted) {
        return;
    }
    let allowed = maximum.map_or(wanted, |maximum| maximum.min(wanted));
    let raised = setrlimit(Resource::Nofile, Rlimit { current: Some(allowed), maximum });
    if raised.is_err() || allowed < wanted {
        tracing::warn!(wanted, ?current, ?maximum, "too few file descriptors for --max-actors: raise `ulimit -n`");
    }
}

async fn listen(options: &Options, flag: &str, port: u16) -> Result<TcpListener> {
    let address = SocketAddr::new(options.address, port);
    TcpListener::bind(address)
        .await
        .map_err(Error::system(format!("cannot listen on {address}: choose another --{flag}, or 0 for any free one")))
}

type Training = oneshot::Receiver<Result<Ending>>;

fn start_trainer(setup: Setup) -> Result<Training> {
    let (ended, training) = oneshot::channel();
    std::thread::Builder::new()
        .name("trainer".into())
        .spawn(move || {
            let ending = catch_unwind(AssertUnwindSafe(|| Ok(Trainer::new(setup)?.run()?)));
            let _ = ended.send(ending.unwrap_or_else(|_| Err(Error::Panicked("the trainer"))));
        })
        .map_err(Error::system("cannot start the trainer's thread"))?;
    Ok(training)
}

fn prepare(
    options: &Options,
    experiment: Experiment,
    backend: Backend,
    security: Security,
) -> Result<(Setup, Arc<Shared>)> {
    let catalogue = Catalogue::open(&experiment.clips)?;
    let names = catalogue.entries().iter().map(|entry| entry.name.clone()).collect();
    let spec = TaskSpec::new(&experiment, names).map_err(|name| {
        Error::configuration(format!("tracking.observations: the tracking task has no observation `{name}`"))
    })?;
    let pose = match experiment.network.initial_pose {
        InitialPose::MidRange => vec![0.0; spec.action],
        InitialPose::ReferenceMean => catalogue.mean_action()?.iter().map(|action| *action as f32).collect(),
    };
    let store = Store::open(&options.run, experiment.learner.checkpoints_kept)?;
    let resume = store.newest()?;
    if let Some((path, snapshot)) = &resume {
        check_same_experiment(&experiment, &spec, snapshot, options.allow_changed)
            .map_err(|error| incompatible(&options.run, error))?;
        tracing::info!(checkpoint = %path.display(), "resuming");
    }
    let resume = resume.map(|(_, snapshot)| snapshot);
    let epoch = store.begin_epoch()?;
    let document = options.run.join("experiment.toml");
    std::fs::write(&document, experiment.to_toml()?).map_err(Error::file("write", document))?;
    let ledger = match &resume {
        Some(snapshot) => accounting(snapshot).map_err(|error| incompatible(&options.run, error))?,
        None => Ledger::new(),
    };
    let ledger = ledger.with_tasks(spec.tasks.iter().map(|task| task.name.clone()));
    let layout = Arc::new(UnrollLayout::new(UnrollShape::new(&spec, &experiment)));
    let config = batches(&experiment.unroll);
    let batcher = Batcher::new(layout, config, Phase::begin(epoch), ledger);
    let publisher = Publisher::new(epoch);
    let shared = Shared::new(service::Setup {
        run: options.run.clone(),
        id: store.run()?,
        security,
        limits: options.limits.clone(),
        experiment: experiment.clone(),
        spec: spec.clone(),
        assets: catalogue.assets()?,
        batcher: batcher.clone(),
        publisher: publisher.clone(),
        quarantine: options.quarantine.clone(),
    })?;
    let run = options.run.clone();
    let setup =
        Setup { experiment, spec, pose, backend, run, epoch, resume, batcher, publisher, shared: shared.clone() };
    Ok((setup, shared))
}

/// What a checkpoint says of every unroll so far.
fn accounting(snapshot: &Snapshot) -> Result<Ledger> {
    let accounting = serde_json::from_slice(snapshot.part("accounting.json")?);
    let accounting = accounting.map_err(Error::json("accounting.json of the checkpoint"))?;
    Ledger::restore(&accounting).map_err(Error::within("accounting.json of the checkpoint cannot be used"))
}

/// How unrolls become batches.
fn batches(unroll: &Unroll) -> Config {
    let Unroll { batch, max_staleness, ahead, lockstep, .. } = *unroll;
    let (order, max_staleness) =
        if lockstep { (BatchOrder::Environment, 0) } else { (BatchOrder::Arrival, max_staleness) };
    Config { unrolls: batch, max_staleness, ahead, order }
}

/// A run goes on only as the experiment it was, unless it is allowed to change; how long, how often and with how many
/// threads may always.
fn check_same_experiment(now: &Experiment, spec: &TaskSpec, snapshot: &Snapshot, allowed: bool) -> Result<()> {
    let then = Experiment::from_toml("experiment.toml of the checkpoint", snapshot.text("experiment.toml")?)?;
    let mut now = now.clone();
    now.budget = then.budget.clone();
    now.learner = then.learner.clone();
    now.actor = then.actor.clone();
    let changed = |Difference { field, ours, theirs }| format!("{field} was {ours} and is {theirs}");
    let mut changes: Vec<String> = then.differences(&now)?.into_iter().map(changed).collect();
    let task = serde_json::from_slice::<TaskSpec>(snapshot.part("task.json")?);
    let task = task.map_err(Error::json("task.json of the checkpoint"))?;
    if changes.is_empty() && task != *spec {
        changes.push("the clips, or what the task observes and pays, are others".into());
    }
    if changes.is_empty() {
        return Ok(());
    }
    let changes = changes.join("; ");
    if allowed {
        tracing::warn!("the run goes on as another experiment: {changes}");
        return Ok(());
    }
    Err(Error::configuration(format!(
        "it was made by another experiment ({changes}): give another --run, the old values, or --allow-changed"
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resumed(change: impl FnOnce(&mut Experiment), allowed: bool) -> Result<()> {
        let then = Experiment::default();
        let spec = TaskSpec::new(&then, vec!["walk".into()]).unwrap();
        let mut snapshot = Snapshot::default();
        snapshot.parts.insert("experiment.toml".into(), then.to_toml()?.into_bytes());
        snapshot.parts.insert("task.json".into(), serde_json::to_vec(&spec).unwrap());
        let mut now = then;
        change(&mut now);
        check_same_experiment(&now, &spec, &snapshot, allowed)
    }

    #[test]
    fn another_experiment_is_refused_with_every_field_that_differs() {
        let change = |experiment: &mut Experiment| {
            experiment.vmpo.lambda = 0.5;
            experiment.network.latent.beta = 0.25;
        };
        let refused = resumed(change, false).unwrap_err();
        assert_eq!(refused.exit_code(), 2);
        let said = refused.to_string();
        for part in ["vmpo.lambda was", "is 0.5", "network.latent.beta was", "is 0.25", "--allow-changed"] {
            assert!(said.contains(part), "no `{part}` in {said}");
        }
        assert!(resumed(change, true).is_ok());
    }

    #[test]
    fn how_long_and_how_often_may_always_change() {
        let change = |experiment: &mut Experiment| {
            experiment.budget.minutes = 7.0;
            experiment.learner.checkpoint_seconds = 8.0;
            experiment.actor.threads = 9;
        };
        assert!(resumed(change, false).is_ok());
    }
}
