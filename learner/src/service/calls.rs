//! An answer to each call of the protocol.

use std::sync::Arc;
use std::time::Instant;

use comic_proto::PROTOCOL_VERSION;
use comic_proto::v1::learner_server::Learner;
use comic_proto::v1::{
    self, AssetChunk, AssetRequest, EvaluationAck, EvaluationReport, JoinReply, JoinRequest, ParametersChunk,
    StatusRequest, UnrollAck, UnrollMessage, WatchRequest,
};
use futures::stream::{self, BoxStream, StreamExt as _};
use serde::de::IgnoredAny;
use tonic::{Request, Response, Status, Streaming};

use super::unrolls::UnrollStream;
use super::{Evaluation, Shared, assets, status};

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
        let JoinRequest { incarnation, actor, protocol } = request.into_inner();
        let shared = &self.shared;
        let joins = &shared.telemetry.joins;
        if protocol != PROTOCOL_VERSION {
            joins.of("refused").inc();
            return Err(Status::failed_precondition(format!(
                "this learner speaks protocol {PROTOCOL_VERSION}, the actor {protocol}: run both from the same release"
            )));
        }
        if !shared.roster.join(incarnation, Instant::now()) {
            joins.of("full").inc();
            return Err(Status::resource_exhausted("as many actors as --max-actors allows are here: try again later"));
        }
        let joined = shared.batcher.join(incarnation, actor).map_err(|refused| {
            joins.of("refused").inc();
            Status::failed_precondition(refused.to_string())
        })?;
        joins.of("joined").inc();
        tracing::info!(actor = joined.actor, incarnation = format_args!("{incarnation:016x}"), peer = ?peer, "actor joined");
        Ok(Response::new(JoinReply {
            learner_epoch: shared.publisher.epoch(),
            actor: joined.actor,
            seed: actor_seed(shared.seed, joined.actor),
            experiment: shared.experiment.clone(),
            task_spec: shared.task_spec.clone(),
            assets: shared.assets.iter().map(assets::described).collect(),
            layout_hash: shared.batcher.layout().hash().to_vec(),
            next_sequence: joined.next_sequence,
        }))
    }

    async fn fetch_asset(&self, request: Request<AssetRequest>) -> Result<Response<Self::FetchAssetStream>, Status> {
        let AssetRequest { sha256 } = request.into_inner();
        Ok(Response::new(assets::open(&self.shared, &sha256).await?.boxed()))
    }

    async fn send_unrolls(
        &self,
        request: Request<Streaming<UnrollMessage>>,
    ) -> Result<Response<Self::SendUnrollsStream>, Status> {
        let unrolls = UnrollStream::new(self.shared.clone(), request.into_inner());
        Ok(Response::new(stream::unfold(unrolls, UnrollStream::next).boxed()))
    }

    /// [`broadcast`](super::broadcast) answers this call before it comes here.
    async fn watch_parameters(
        &self,
        _: Request<WatchRequest>,
    ) -> Result<Response<Self::WatchParametersStream>, Status> {
        Err(Status::internal("WatchParameters has missed its way"))
    }

    async fn report_evaluation(&self, request: Request<EvaluationReport>) -> Result<Response<EvaluationAck>, Status> {
        let EvaluationReport { learner_epoch: epoch, version, json } = request.into_inner();
        if let Err(error) = serde_json::from_str::<IgnoredAny>(&json) {
            return Err(Status::invalid_argument(format!("the report is no JSON: {error}")));
        }
        if !self.shared.keep_evaluation(Evaluation { epoch, version, json }) {
            return Err(Status::resource_exhausted("too many evaluations wait for the trainer: report this one later"));
        }
        self.shared.telemetry.evaluations.inc();
        Ok(Response::new(EvaluationAck {}))
    }

    async fn get_status(&self, _: Request<StatusRequest>) -> Result<Response<v1::Status>, Status> {
        Ok(Response::new(status::of(&self.shared)))
    }
}

/// An actor's seed: the same for the same index of the same experiment, whatever process has it (SplitMix64).
fn actor_seed(experiment: u64, actor: u64) -> u64 {
    let mut z = experiment.wrapping_add(actor.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
