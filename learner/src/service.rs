//! The learner as actors see it: gRPC over tokio.
//!
//! # Layout
//! - [`Shared`] is what all calls have in common: the experiment, the batcher, the publisher.
//! - [`serve`] is the server, up to its graceful end.
//! - `incoming` lets connections in, `admission` calls: TLS, tokens and limits are theirs, and nobody else's.
//! - `calls` answers each call; `unrolls`, `assets`, and `broadcast` of what is [published](crate::publish) are the streams
//!   with a life of their own. `streams` leads the two that carry bytes past tonic's codec, `messages` takes those of one
//!   apart, as there is room for them. `status` tells how things are,
//!   `roster` how the actors are. `assignments` says which actor simulates what of a run in lockstep. `log_limiter` keeps the log
//!   readable when a peer misbehaves.
//!
//! Streams are pulled: nothing is read from an actor until the unroll before it has a slot in a batch, so HTTP/2 flow
//! control carries the batcher's back-pressure to the actor, and no queue lies in between.

mod admission;
mod assets;
mod assignments;
mod broadcast;
mod calls;
mod incoming;
pub mod memory;
mod messages;
pub mod quarantine;
mod roster;
mod status;
mod streams;
mod unrolls;

use std::collections::VecDeque;
use std::future::Future;
use std::path::PathBuf;
use std::pin::pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use comic_clips::Asset;
use comic_experiment::{Experiment, TaskSpec};
use comic_proto::v1::learner_server::LearnerServer;
use comic_proto::{FILE_DESCRIPTOR_SET, UnrollLayout, UnrollShape};
use comic_replay::Batcher;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tonic::Status;
use tonic::transport::Server;
use tonic_health::ServingStatus;

use crate::error::{Error, Result};
use crate::log_limiter::LogLimiter;
use crate::observe::evaluation::Evaluation;
use crate::observe::telemetry::Telemetry;
use crate::publish::Publisher;
use crate::security::{ConnectionLimits, Security, Tls, Tokens};
use crate::service::memory::Ingest;
use crate::service::quarantine::{Quarantine, QuarantineOptions};
use admission::Admission;
use assignments::Assignments;
use calls::Calls;
use incoming::Acceptor;
use messages::Room;
use roster::Roster;
use streams::Streams;

/// A peer that answers no ping for [`KEEPALIVE_TIMEOUT`] is gone; without pings a half-open one is never noticed. Thirty
/// seconds are promised, on a busy machine too.
const KEEPALIVE: Duration = Duration::from_secs(10);
/// See [`KEEPALIVE`].
const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(10);
/// A call has to be answered, or its stream begun, in this time. A stream that has begun is not limited.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);
/// What a message has beside the numbers of an unroll in which one episode ends. More makes two frames of every message.
const HEADER: usize = 128;
/// An unroll of 200 KB in frames of HTTP/2's default 16 KiB costs five times the processor time.
pub(crate) const FRAME_SIZE: u32 = 256 * 1024;
/// Bytes that a connection may have under way beside a stream that is not read, or such a one would stall every other call
/// of its actor.
const BESIDE: u32 = 128 * 1024;
/// RFC 9113, 6.9.2: so much a peer may send before it has heard of any other.
pub(crate) const SMALLEST_WINDOW: u32 = 65_535;
/// RFC 9113, 6.9.1.
const LARGEST_WINDOW: u32 = (1 << 31) - 1;
/// Streams a connection may have open; an actor needs three.
const MAX_STREAMS: u32 = 64;
/// The decoding limit when unrolls are smaller than that: a report on many clips is JSON of some hundred KB.
const MIN_MESSAGE_LIMIT: usize = 1024 * 1024;
/// Streams end themselves on the signal; a connection whose peer reads nothing is left behind after this time.
const GRACE: Duration = Duration::from_secs(1);
/// Evaluations that may wait for the trainer.
const EVALUATIONS: usize = 16;

/// What the service is made of.
#[derive(Debug)]
pub struct Setup {
    /// The run's directory, for those who ask.
    pub run: PathBuf,
    /// What tells this run from every other.
    pub id: u64,
    /// Who gets in.
    pub security: Security,
    /// How many get in.
    pub limits: ConnectionLimits,
    /// The resolved experiment, handed to every actor.
    pub experiment: Experiment,
    /// The task's sizes and names, handed to every actor.
    pub spec: TaskSpec,
    /// Files actors may lack.
    pub assets: Vec<Asset>,
    /// Where unrolls go.
    pub batcher: Batcher,
    /// Where parameters come from; its epoch is the service's.
    pub publisher: Publisher,
    /// Where invalid unrolls go.
    pub quarantine: QuarantineOptions,
}

/// What all calls, and the trainer, have in common.
#[derive(Debug)]
pub struct Shared {
    experiment: String,
    task_spec: String,
    seed: u64,
    /// Of each task.
    clips: Vec<usize>,
    assets: Vec<Asset>,
    batcher: Batcher,
    publisher: Publisher,
    metrics: Mutex<String>,
    evaluations: Mutex<VecDeque<Evaluation>>,
    log_limiter: LogLimiter<u64>,
    /// The experiment's name.
    name: String,
    run: PathBuf,
    id: u64,
    since: Instant,
    /// Unrolls that the batches have room for: open, full, ahead, and at the trainer.
    capacity: u64,
    tls: Option<Arc<Tls>>,
    tokens: Option<Arc<Tokens>>,
    limits: ConnectionLimits,
    message_limit: usize,
    /// Bytes unread on a stream.
    window: u32,
    room: Room,
    roster: Arc<Roster>,
    quarantine: Option<Quarantine>,
    /// Of a run in lockstep.
    assignments: Option<Assignments>,
    /// Of an actor whose command line says nothing else: threads, and environments of each.
    actor: (u64, u64),
    /// What Prometheus reads.
    pub telemetry: Arc<Telemetry>,
    /// From the signal on: nobody else comes in.
    draining: watch::Sender<bool>,
    closing: watch::Sender<bool>,
}

impl Shared {
    /// Everything ready to serve.
    ///
    /// # Errors
    /// [`Error::Configuration`] when no unroll fits the limit of a message; otherwise when the batcher's layout or epoch are not those
    /// of the rest, experiment or spec cannot be written as TOML, or there is no quarantine where one was asked for.
    pub fn new(setup: Setup) -> Result<Arc<Self>> {
        let Setup { run, id, security, limits, experiment, spec, assets, batcher, publisher, quarantine } = setup;
        let shape = UnrollShape::new(&spec, &experiment);
        let found = *batcher.layout().shape();
        if shape != found {
            let what = format!("the batcher takes unrolls of {found:?}, the experiment makes {shape:?}");
            return Err(Error::Defect(what));
        }
        let (epoch, found) = (publisher.epoch(), batcher.phase().epoch);
        if epoch != found {
            return Err(Error::Defect(format!("the batcher is in learner epoch {found}, the publisher in {epoch}")));
        }
        let needed = batcher.layout().message_limit();
        let message_limit = limits.max_message_bytes.unwrap_or(needed.max(MIN_MESSAGE_LIMIT));
        if message_limit < needed {
            let remedy = format!("--max-message-bytes {message_limit} lets no unroll through: it takes {needed}");
            return Err(Error::Configuration(remedy));
        }
        if limits.max_ingest_bytes < message_limit {
            let room = limits.max_ingest_bytes;
            let remedy =
                format!("--max-ingest-bytes {room} has no room for one message, of {message_limit} bytes at most");
            return Err(Error::Configuration(remedy));
        }
        let telemetry = Arc::<Telemetry>::default();
        let buffers = experiment.unroll.ahead as u64 + 1;
        Ok(Arc::new(Self {
            name: experiment.name.clone(),
            run,
            id,
            since: Instant::now(),
            capacity: buffers * experiment.unroll.batch as u64,
            tls: security.tls.map(Arc::new),
            tokens: security.tokens.map(Arc::new),
            message_limit,
            window: limits.max_unread_bytes.unwrap_or_else(|| window(batcher.layout())),
            room: Room::new(limits.max_ingest_bytes, telemetry.unrolls_late.clone()),
            roster: Arc::new(Roster::new(limits.max_actors)),
            assignments: experiment.unroll.lockstep.then(|| Assignments::new(experiment.unroll.batch)),
            actor: (experiment.actor.threads as u64, experiment.actor.environments as u64),
            limits,
            quarantine: Quarantine::start(&quarantine, &telemetry)?,
            telemetry,
            task_spec: toml::to_string(&spec)
                .map_err(|error| Error::Defect(format!("the task's specification is no TOML: {error}")))?,
            seed: experiment.seed,
            experiment: experiment.to_toml()?,
            clips: spec.tasks.iter().map(|task| task.clips).collect(),
            assets,
            batcher,
            publisher,
            metrics: Mutex::new(String::from("{}")),
            evaluations: Mutex::new(VecDeque::new()),
            log_limiter: LogLimiter::default(),
            draining: watch::Sender::new(false),
            closing: watch::Sender::new(false),
        }))
    }

    /// Replaces the metrics that `GetStatus` answers with, JSON.
    pub fn set_metrics(&self, json: String) {
        *lock(&self.metrics) = json;
    }

    /// What tells this run from every other.
    pub(crate) fn id(&self) -> u64 {
        self.id
    }

    /// Takes the evaluations reported since the last time, oldest first.
    pub fn take_evaluations(&self) -> Vec<Evaluation> {
        lock(&self.evaluations).drain(..).collect()
    }

    /// What bounds the bytes that peers have on their way.
    pub(crate) fn ingest(&self) -> Ingest {
        Ingest {
            connections: self.limits.max_connections(),
            window: self.window.saturating_add(BESIDE) as usize,
            room: self.limits.max_ingest_bytes,
            requests: self.limits.max_requests,
            message: self.message_limit,
            quarantined: if self.quarantine.is_some() { Quarantine::HELD } else { 0 },
        }
    }

    /// From now on nobody else comes in, and who looks is told that the server goes down.
    pub fn drain(&self) {
        self.draining.send_replace(true);
    }

    /// Whether the server goes down.
    pub(crate) fn is_draining(&self) -> bool {
        *self.draining.borrow() || *self.closing.borrow()
    }

    /// What streams end with when the server closes: `None` once the run is over, which actors were told.
    fn parting(&self) -> Option<Status> {
        let over = self.publisher.newest().is_some_and(|newest| newest.run_over);
        (!over).then(calls::draining)
    }

    /// Keeps an evaluation for the trainer. False when too many wait already.
    pub fn keep_evaluation(&self, evaluation: Evaluation) -> bool {
        let mut waiting = lock(&self.evaluations);
        let room = waiting.len() < EVALUATIONS;
        if room {
            waiting.push_back(evaluation);
        }
        room
    }

    fn closing(&self) -> Closing {
        Closing(self.closing.subscribe())
    }
}

/// The signal on which streams end themselves.
#[derive(Clone, Debug)]
struct Closing(watch::Receiver<bool>);

impl Closing {
    /// Waits for the signal, for ever if need be. Cancel-safe.
    async fn begun(&mut self) {
        // An error means that `Shared` is gone, and the server with it.
        let _ = self.0.wait_for(|closing| *closing).await;
    }

    fn has_begun(&self) -> bool {
        *self.0.borrow()
    }
}

/// Nothing panics while it holds one of these locks, and none guards more than one value.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Bytes that a stream may have under way unread, unless an operator says otherwise: one unroll's message, so that it comes
/// in one frame, as good as whole, or waits at its actor. What is cut, where a window ends, has to be copied to be joined,
/// keeps the buffers of both its halves, and costs twice the processor time.
pub fn window(layout: &UnrollLayout) -> u32 {
    u32::try_from(layout.size().saturating_add(HEADER)).unwrap_or(u32::MAX).clamp(SMALLEST_WINDOW, LARGEST_WINDOW)
}

/// HTTP/2 as actors meet it, with so many bytes unread on a stream.
pub fn server(window: u32) -> Server {
    Server::builder()
        .http2_keepalive_interval(Some(KEEPALIVE))
        .http2_keepalive_timeout(Some(KEEPALIVE_TIMEOUT))
        .initial_stream_window_size(window)
        .initial_connection_window_size(window.saturating_add(BESIDE).min(LARGEST_WINDOW))
        .max_frame_size(FRAME_SIZE)
        .max_concurrent_streams(MAX_STREAMS)
        .timeout(ANSWER_TIMEOUT)
}

/// Serves actors on this listener until `shutdown`, then ends every stream and returns, after a second at most.
///
/// `Shared` is served once: after `shutdown` its streams stay ended.
///
/// # Errors
/// When the server cannot go on accepting connections.
pub async fn serve(listener: TcpListener, shared: Arc<Shared>, shutdown: impl Future<Output = ()>) -> Result<()> {
    let calls = LearnerServer::new(Calls::new(shared.clone())).max_decoding_message_size(shared.message_limit);
    let (reporter, health) = tonic_health::server::health_reporter();
    reporter.set_serving::<LearnerServer<Calls>>().await;
    let reflection = tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
        .build_v1()
        .map_err(|error| Error::Defect(format!("the protocol's descriptors are damaged: {error}")))?;
    let telemetry = &shared.telemetry;
    let admission = Admission::new(shared.tokens.clone(), shared.limits.max_requests, telemetry.clone());
    let door = Acceptor::new(shared.tls.clone(), &shared.limits, telemetry.clone());
    let mut closing = shared.closing();
    let server = server(shared.window)
        .layer(admission)
        .add_service(Streams::new(calls, shared.clone()))
        .add_service(health)
        .add_service(reflection)
        .serve_with_incoming_shutdown(door.open(listener), async move {
            closing.begun().await;
        });
    let mut server = pin!(server);
    let draining = async {
        Closing(shared.draining.subscribe()).begun().await;
        for service in ["", "comic.v1.Learner"] {
            reporter.set_service_status(service, ServingStatus::NotServing).await;
        }
        std::future::pending().await
    };
    tokio::select! {
        served = &mut server => return Ok(served?),
        () = draining => {}
        () = shutdown => {}
    }
    for service in ["", "comic.v1.Learner"] {
        reporter.set_service_status(service, ServingStatus::NotServing).await;
    }
    shared.closing.send_replace(true);
    match tokio::time::timeout(GRACE, server).await {
        Ok(served) => Ok(served?),
        Err(_) => {
            tracing::warn!("some actors did not read to the end of their streams; their connections are abandoned");
            Ok(())
        }
    }
}
