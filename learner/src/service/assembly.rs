//! The parts of the service, and who gets which.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use comic_clips::Asset;
use comic_experiment::{Experiment, TaskSpec};
use comic_proto::UnrollShape;
use comic_replay::Batcher;
use parking_lot::Mutex;

use super::assets::Assets;
use super::assignments::Assignments;
use super::authorisation::PUBLIC_CALLS;
use super::calls::Calls;
use super::evaluations::Evaluations;
use super::framing::parameters::Parameters;
use super::framing::unrolls::Unrolls;
use super::http2::{connection_window, window};
use super::intake::Intake;
use super::join::{self, Join, JoinTerms};
use super::memory::IngestLimits;
use super::offer::{NewestCheckpoint, Offer, description};
use super::placement::Placement;
use super::quarantine::{Quarantine, QuarantineArguments};
use super::room::Room;
use super::roster::{Absent, Roster};
use super::shutdown::Shutdown;
use super::status::StatusBoard;
use crate::checkpoint::Name;
use crate::error::{Error, Result};
use crate::log_limiter::LogLimiter;
use crate::observe::evaluation::Evaluation;
use crate::observe::heartbeat::Heartbeat;
use crate::observe::probes::Probed;
use crate::observe::prometheus::Prometheus;
use crate::publish::Publisher;
use crate::security::{ConnectionLimits, Security, Tls, Tokens};

/// The smallest default limit of a message, bytes, where unrolls are smaller: an evaluation of many clips is JSON of some
/// hundred KB.
const MIN_MESSAGE_LIMIT: usize = 1024 * 1024;

/// What a service is made of.
#[derive(Debug)]
pub struct Setup {
    /// The run's directory, which the status shows.
    pub run: PathBuf,
    /// The run's number, which no other run has.
    pub id: u64,
    /// TLS and tokens.
    pub security: Security,
    /// How many connections, calls and bytes are accepted.
    pub limits: ConnectionLimits,
    /// The resolved experiment, which every actor receives.
    pub experiment: Experiment,
    /// The task's sizes and names, which every actor receives.
    pub spec: TaskSpec,
    /// Files that actors may not have.
    pub assets: Vec<Asset>,
    /// Where unrolls go.
    pub batcher: Batcher,
    /// Where parameters come from. Its learner epoch is the service's.
    pub publisher: Publisher,
    /// Where invalid unrolls go.
    pub quarantine: QuarantineArguments,
    /// Which actors belong elsewhere, if several learners train this run.
    pub placement: Option<Placement>,
}

impl Setup {
    /// The largest message that is accepted, bytes.
    ///
    /// # Errors
    /// [`Error::Configuration`] when no unroll fits into the limits; [`Error::Defect`] when the batcher's layout or epoch is
    /// not that of the experiment or the publisher.
    fn message_limit(&self) -> Result<usize> {
        let Self { limits, batcher, .. } = self;
        let shape = UnrollShape::new(&self.spec, &self.experiment);
        let found = *batcher.layout().shape();
        if shape != found {
            let what = format!("the batcher takes unrolls of {found:?}, the experiment makes {shape:?}");
            return Err(Error::Defect(what));
        }
        let (epoch, found) = (self.publisher.epoch(), batcher.phase().epoch);
        if epoch != found {
            return Err(Error::Defect(format!("the batcher is in learner epoch {found}, the publisher in {epoch}")));
        }
        let needed = batcher.layout().message_limit();
        let limit = limits.max_message_bytes.unwrap_or(needed.max(MIN_MESSAGE_LIMIT));
        if limit < needed {
            let what = format!("--max-message-bytes {limit} is too small for an unroll: it needs {needed}");
            return Err(Error::Configuration(what));
        }
        if limits.max_ingest_bytes < limit {
            let room = limits.max_ingest_bytes;
            let what = format!("--max-ingest-bytes {room} is too small for one message, which can have {limit} bytes");
            return Err(Error::Configuration(what));
        }
        Ok(limit)
    }
}

/// The service of one learner epoch; a handle that can be cloned. It is served once: when it has closed, its streams stay
/// ended.
#[derive(Clone, Debug)]
pub struct Service {
    pub(super) gate: Arc<Gate>,
    pub(super) calls: Arc<Calls>,
    pub(super) unrolls: Arc<Unrolls>,
    pub(super) parameters: Arc<Parameters>,
    pub(super) shutdown: Shutdown,
    trainer: TrainerHandle,
}

/// What connections and calls must pass.
#[derive(Debug)]
pub(super) struct Gate {
    pub(super) tls: Option<Arc<Tls>>,
    pub(super) tokens: Option<Arc<Tokens>>,
    pub(super) limits: ConnectionLimits,
    /// Bytes of the largest message.
    pub(super) message_limit: usize,
    /// Bytes that a stream may have unread.
    pub(super) window: u32,
    pub(super) prometheus: Arc<Prometheus>,
}

impl Service {
    /// All parts, ready to serve.
    ///
    /// # Errors
    /// [`Error::Configuration`] when no unroll fits into the limits; otherwise when the batcher's layout or epoch is not that of
    /// the experiment or the publisher, when the experiment cannot be written as TOML, or when the quarantine cannot start.
    pub fn new(setup: Setup) -> Result<Self> {
        let message_limit = setup.message_limit()?;
        let common = Common::new(&setup);
        let Setup { run, id, security, limits, experiment, spec, assets, quarantine, placement, .. } = setup;
        let Common { publisher, roster, room, shutdown, prometheus, .. } = common.clone();
        let terms = JoinTerms::new(id, &experiment, &spec, assets.iter().map(description).collect())?;
        let quarantine = Quarantine::start(&quarantine, &prometheus)?;
        let quarantines = quarantine.is_some();
        let (evaluations, checkpoint) = (Evaluations::new(id), NewestCheckpoint::default());
        let status = Arc::new(common.status(run, &experiment));
        let gate = Gate {
            tls: security.tls.map(Arc::new),
            tokens: security.tokens.map(Arc::new),
            message_limit,
            window: limits.max_unread_bytes.unwrap_or_else(|| window(common.batcher.layout())),
            limits,
            prometheus: prometheus.clone(),
        };
        let placement = placement.map(Arc::new);
        let calls = Calls {
            join: common.join(terms, placement.clone()),
            assets: Assets::new(assets, checkpoint.clone(), shutdown.clone()),
            evaluations: evaluations.clone(),
            status: status.clone(),
            prometheus: prometheus.clone(),
        };
        let intake = common.intake(&spec, quarantine);
        let ingest = gate.ingest_limits(quarantines);
        Ok(Self {
            gate: Arc::new(gate),
            calls: Arc::new(calls),
            unrolls: Arc::new(Unrolls { intake, message_limit, room, shutdown: shutdown.clone() }),
            parameters: Arc::new(Parameters { publisher, roster, shutdown: shutdown.clone() }),
            shutdown,
            trainer: TrainerHandle { run: id, prometheus, evaluations, checkpoint, status, ingest, placement },
        })
    }

    /// What the trainer needs of the service.
    pub fn trainer(&self) -> TrainerHandle {
        self.trainer.clone()
    }

    /// What `/metrics`, `/healthz` and `/readyz` show.
    pub fn probed(&self) -> Arc<impl Probed + use<>> {
        self.trainer.status.clone()
    }

    /// The evaluations that wait for the trainer.
    pub fn evaluations(&self) -> &Evaluations {
        &self.trainer.evaluations
    }

    /// The actors that were here lately and have no connection now.
    pub fn absent(&self) -> Absent {
        self.parameters.roster.absent(Instant::now())
    }

    /// From now on no actor can join, and the health service says that the learner does not serve.
    pub fn drain(&self) {
        self.shutdown.drain();
    }
}

/// What several parts share.
#[derive(Clone)]
struct Common {
    batcher: Batcher,
    publisher: Publisher,
    roster: Arc<Roster>,
    /// Only in lockstep.
    assignments: Option<Arc<Assignments>>,
    room: Room,
    shutdown: Shutdown,
    prometheus: Arc<Prometheus>,
}

impl Common {
    fn new(setup: &Setup) -> Self {
        let Setup { limits, experiment, batcher, publisher, .. } = setup;
        let prometheus = Arc::<Prometheus>::default();
        let lockstep = experiment.unroll.lockstep;
        Self {
            batcher: batcher.clone(),
            publisher: publisher.clone(),
            roster: Arc::new(Roster::new(limits.max_actors)),
            assignments: lockstep.then(|| Arc::new(Assignments::new(experiment.unroll.batch))),
            room: Room::new(limits.max_ingest_bytes, prometheus.unrolls_late.clone()),
            shutdown: Shutdown::new(publisher.clone()),
            prometheus,
        }
    }

    fn status(&self, run: PathBuf, experiment: &Experiment) -> StatusBoard {
        let Self { batcher, publisher, roster, room, shutdown, prometheus, .. } = self.clone();
        StatusBoard {
            run,
            experiment: experiment.name.clone(),
            started: Instant::now(),
            capacity: batcher.capacity() as u64,
            metrics: Mutex::new(String::from("{}")),
            batcher,
            publisher,
            roster,
            room,
            prometheus,
            shutdown,
            heartbeat: Heartbeat::default(),
        }
    }

    fn join(&self, terms: JoinTerms, placement: Option<Arc<Placement>>) -> Join {
        let Self { batcher, publisher, roster, assignments, shutdown, prometheus, .. } = self.clone();
        let (epoch, joins) = (publisher.epoch(), join::joins());
        Join { terms, batcher, roster, assignments, shutdown, prometheus, epoch, joins, placement }
    }

    fn intake(&self, spec: &TaskSpec, quarantine: Option<Quarantine>) -> Intake {
        let Self { batcher, publisher, roster, assignments, shutdown, prometheus, .. } = self.clone();
        let clips = spec.tasks.iter().map(|task| task.clips).collect();
        let log_limiter = LogLimiter::default();
        Intake { batcher, publisher, clips, roster, assignments, quarantine, shutdown, prometheus, log_limiter }
    }
}

impl Gate {
    /// The limits on the bytes that peers send.
    fn ingest_limits(&self, quarantines: bool) -> IngestLimits {
        IngestLimits {
            connections: self.limits.max_connections(),
            window: connection_window(self.window) as usize,
            room: self.limits.max_ingest_bytes,
            requests: self.limits.max_requests.saturating_add(PUBLIC_CALLS),
            message: self.message_limit,
            quarantined: if quarantines { Quarantine::HELD } else { 0 },
        }
    }
}

/// What the trainer needs of the service; a handle that can be cloned.
#[derive(Clone, Debug)]
pub struct TrainerHandle {
    run: u64,
    /// Counts what the trainer does.
    pub prometheus: Arc<Prometheus>,
    evaluations: Evaluations,
    checkpoint: NewestCheckpoint,
    status: Arc<StatusBoard>,
    ingest: IngestLimits,
    placement: Option<Arc<Placement>>,
}

impl TrainerHandle {
    /// The run's number, which no other run has.
    pub fn id(&self) -> u64 {
        self.run
    }

    /// The number of actors that are connected, if anyone asks.
    pub fn actors(&self) -> u64 {
        self.placement.as_ref().map_or(0, |_| self.status.actors())
    }

    /// Tells how many actors each rank has, for those that come.
    pub fn place_actors(&self, actors: &[u64]) {
        if let Some(placement) = &self.placement {
            placement.count(actors, Instant::now());
        }
    }

    /// Notes that the trainer moves. A learner whose trainer does not move is not healthy.
    pub fn beat(&self) {
        self.status.heartbeat.beat();
    }

    /// Replaces the metrics that `GetStatus` answers with, JSON.
    pub fn set_metrics(&self, json: String) {
        self.status.set_metrics(json);
    }

    /// From now on evaluators get this checkpoint.
    pub fn offer(&self, checkpoint: Offer) {
        self.checkpoint.replace(checkpoint);
    }

    /// The checkpoint that an evaluator fetched lately, which must not be removed before it is judged.
    pub fn held_checkpoint(&self) -> Option<Name> {
        self.checkpoint.held(Instant::now())
    }

    /// Takes the evaluations that actors reported since the last call, oldest first.
    pub fn take_evaluations(&self) -> Vec<Evaluation> {
        self.evaluations.take()
    }

    /// The limits on the bytes that peers send.
    pub fn ingest(&self) -> IngestLimits {
        self.ingest
    }
}
