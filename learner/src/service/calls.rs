//! An answer to each call of the protocol.

use std::sync::Arc;
use std::time::Instant;

use comic_experiment::seed;
use comic_proto::v1::learner_server::Learner;
use comic_proto::v1::{
    self, AssetChunk, AssetRequest, Environments, EvaluationAck, EvaluationReport, JoinReply, JoinRequest,
    ParametersChunk, StatusRequest, UnrollAck, UnrollMessage, WatchRequest,
};
use comic_proto::{MAX_SEQUENCE, PROTOCOL_VERSION};
use futures::stream::{BoxStream, StreamExt as _};
use serde::de::IgnoredAny;
use tonic::{Request, Response, Status, Streaming};

use super::assignments::{Assignment, Denied};
use super::roster::Admission;
use super::{Shared, assets, status};
use crate::observe::evaluation::Evaluation;

/// Bytes of an actor's name, as many as a host's can have.
const NAME_LIMIT: usize = 253;

/// The service, as tonic wants it: one per server, shared by every connection.
#[derive(Debug)]
pub(super) struct Calls {
    shared: Arc<Shared>,
}

impl Calls {
    pub(super) fn new(shared: Arc<Shared>) -> Self {
        Self { shared }
    }
}

#[tonic::async_trait]
impl Learner for Calls {
    type FetchAssetStream = BoxStream<'static, Result<AssetChunk, Status>>;
    type SendUnrollsStream = BoxStream<'static, Result<UnrollAck, Status>>;
    type WatchParametersStream = BoxStream<'static, Result<ParametersChunk, Status>>;

    async fn join(&self, request: Request<JoinRequest>) -> Result<Response<JoinReply>, Status> {
        let peer = request.remote_addr();
        let request = request.into_inner();
        let JoinRequest { incarnation, actor, protocol, acknowledged, .. } = request;
        let shared = &self.shared;
        let joins = &shared.telemetry.joins;
        if protocol != PROTOCOL_VERSION {
            joins.of("refused").inc();
            return Err(Status::failed_precondition(format!(
                "this learner speaks protocol {PROTOCOL_VERSION}, the actor {protocol}: run both from the same release"
            )));
        }
        if acknowledged > MAX_SEQUENCE || request.name.len() > NAME_LIMIT {
            joins.of("refused").inc();
            return Err(Status::invalid_argument(format!(
                "acknowledged are at most {MAX_SEQUENCE} unrolls, not {acknowledged}; a name has {NAME_LIMIT} bytes at most, \
                 not {}",
                request.name.len()
            )));
        }
        // Its unrolls bear epochs and versions that are other policies here.
        if request.run.is_some_and(|run| run != shared.id) {
            joins.of("refused").inc();
            return Err(Status::failed_precondition("another run has begun here since: start the actor again"));
        }
        // Whoever comes when the run is over comes to hear that.
        if shared.is_draining()
            && let Some(parting) = shared.parting()
        {
            joins.of("draining").inc();
            return Err(parting);
        }
        match shared.roster.join(incarnation, &request.name, actor, Instant::now()) {
            Admission::Welcome => {}
            Admission::Full => {
                joins.of("full").inc();
                let said = "as many actors as --max-actors allows are here: try again later";
                return Err(Status::resource_exhausted(said));
            }
            Admission::Superseded => {
                joins.of("refused").inc();
                return Err(superseded());
            }
        }
        let turned_away = |_: &Status| shared.roster.turn_away(incarnation);
        let environments = environments_of(shared, &request).inspect_err(turned_away)?;
        let joined = shared.batcher.join(incarnation, actor).map_err(|refused| {
            joins.of("refused").inc();
            shared.roster.turn_away(incarnation);
            Status::failed_precondition(refused.to_string())
        })?;
        shared.roster.number(incarnation, joined.actor);
        let next_sequence = shared.batcher.catch_up(joined.actor, acknowledged);
        joins.of("joined").inc();
        tracing::info!(actor = joined.actor, incarnation = format_args!("{incarnation:016x}"), peer = ?peer, "actor joined");
        let epoch = shared.publisher.epoch();
        // In lockstep an environment's number makes the difference, not the actor that happens to have it.
        let index = if environments.is_some() { epoch } else { joined.actor };
        Ok(Response::new(JoinReply {
            learner_epoch: epoch,
            actor: joined.actor,
            seed: seed::derive(shared.seed, index),
            experiment: shared.experiment.clone(),
            task_spec: shared.task_spec.clone(),
            assets: shared.assets.iter().map(assets::described).collect(),
            layout_hash: shared.batcher.layout().hash().to_vec(),
            next_sequence,
            environments,
            run: shared.id,
        }))
    }

    async fn fetch_asset(&self, request: Request<AssetRequest>) -> Result<Response<Self::FetchAssetStream>, Status> {
        let AssetRequest { sha256 } = request.into_inner();
        Ok(Response::new(assets::open(&self.shared, &sha256).await?.boxed()))
    }

    /// [`streams`](super::streams) answers this call, and the next, before they come here.
    async fn send_unrolls(
        &self,
        _: Request<Streaming<UnrollMessage>>,
    ) -> Result<Response<Self::SendUnrollsStream>, Status> {
        Err(Status::internal("SendUnrolls has missed its way"))
    }

    async fn watch_parameters(
        &self,
        _: Request<WatchRequest>,
    ) -> Result<Response<Self::WatchParametersStream>, Status> {
        Err(Status::internal("WatchParameters has missed its way"))
    }

    async fn report_evaluation(&self, request: Request<EvaluationReport>) -> Result<Response<EvaluationAck>, Status> {
        let EvaluationReport { learner_epoch: epoch, version, updates, json, run } = request.into_inner();
        if let Err(error) = serde_json::from_str::<IgnoredAny>(&json) {
            return Err(Status::invalid_argument(format!("the report is no JSON: {error}")));
        }
        if !self.shared.keep_evaluation(Evaluation { run, epoch, version, updates, json }) {
            return Err(Status::resource_exhausted("too many evaluations wait for the trainer: report this one later"));
        }
        self.shared.telemetry.evaluations.inc();
        Ok(Response::new(EvaluationAck {}))
    }

    async fn get_status(&self, _: Request<StatusRequest>) -> Result<Response<v1::Status>, Status> {
        Ok(Response::new(status::of(&self.shared)))
    }
}

/// What actors are told while the learner goes down: it comes back, or another one does.
pub(super) fn draining() -> Status {
    Status::unavailable("the learner is draining: reconnect")
}

/// What an actor is told whose place is taken.
pub(super) fn superseded() -> Status {
    Status::aborted("a newer process of the same name took this one's place")
}

/// What an actor simulates of a run in lockstep; nothing in particular otherwise.
fn environments_of(shared: &Shared, request: &JoinRequest) -> Result<Option<Environments>, Status> {
    let JoinRequest { incarnation, actor, threads, environments, .. } = *request;
    let Some(assignments) = &shared.assignments else { return Ok(None) };
    let wanted = threads.map_or(shared.actor.0, u64::from) * environments.map_or(shared.actor.1, u64::from);
    let now = Instant::now();
    let claimed = assignments.claim(incarnation, wanted, actor.is_some(), |owner| shared.roster.expects(owner, now));
    let Assignment { environments, inherited, left } = claimed.map_err(|denied| match denied {
        Denied::Taken => {
            shared.telemetry.joins.of("full").inc();
            Status::resource_exhausted("other actors simulate every environment of this run in lockstep: standing by")
        }
        Denied::Lost => {
            shared.telemetry.joins.of("refused").inc();
            Status::failed_precondition("in lockstep the environments it had were begun anew: start the actor again")
        }
    })?;
    tracing::info!(?environments, left, "in lockstep: every batch waits for every environment");
    if inherited {
        tracing::warn!(?environments, "begun anew by another actor: from here on this run is not what its seed gives");
    }
    Ok(Some(Environments { first: environments.start, count: environments.len() as u32 }))
}
