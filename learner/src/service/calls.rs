//! The calls that tonic decodes: `Join`, `FetchAsset`, `GetCheckpoint`, `ReportEvaluation` and `GetStatus`.

use std::sync::Arc;

use comic_proto::v1::learner_server::Learner;
use comic_proto::v1::{
    self, AssetChunk, AssetRequest, CheckpointReply, CheckpointRequest, EvaluationAck, EvaluationReport, JoinReply,
    JoinRequest, ParametersChunk, StatusRequest, UnrollAck, UnrollMessage, WatchRequest,
};
use futures::stream::{BoxStream, StreamExt as _};
use tonic::{Request, Response, Status, Streaming};

use super::assets::Assets;
use super::evaluations::Evaluations;
use super::join::Join;
use super::peer::Peer;
use super::status::StatusBoard;
use crate::observe::prometheus::Prometheus;

/// tonic's service. A server has one, which all its connections share.
#[derive(Debug)]
pub(super) struct Calls {
    pub(super) join: Join,
    pub(super) assets: Assets,
    pub(super) evaluations: Evaluations,
    pub(super) status: Arc<StatusBoard>,
    pub(super) prometheus: Arc<Prometheus>,
}

#[tonic::async_trait]
impl Learner for Calls {
    type FetchAssetStream = BoxStream<'static, Result<AssetChunk, Status>>;
    type SendUnrollsStream = BoxStream<'static, Result<UnrollAck, Status>>;
    type WatchParametersStream = BoxStream<'static, Result<ParametersChunk, Status>>;

    async fn join(&self, request: Request<JoinRequest>) -> Result<Response<JoinReply>, Status> {
        let peer = request.extensions().get::<Peer>().cloned();
        self.join.answer(&request.into_inner(), peer.as_ref()).map(Response::new)
    }

    async fn fetch_asset(&self, request: Request<AssetRequest>) -> Result<Response<Self::FetchAssetStream>, Status> {
        let AssetRequest { sha256 } = request.into_inner();
        Ok(Response::new(self.assets.read(&sha256).await?.boxed()))
    }

    async fn get_checkpoint(&self, _: Request<CheckpointRequest>) -> Result<Response<CheckpointReply>, Status> {
        let (checkpoint, run_over) = (self.assets.newest_checkpoint(), self.status.publisher.run_is_over());
        Ok(Response::new(CheckpointReply { checkpoint, run_over }))
    }

    async fn report_evaluation(&self, request: Request<EvaluationReport>) -> Result<Response<EvaluationAck>, Status> {
        if self.status.publisher.run_is_over() {
            return Err(Status::unavailable("the run is over, and the trainer takes no evaluations"));
        }
        self.evaluations.report(request.into_inner())?;
        self.prometheus.evaluations.inc();
        Ok(Response::new(EvaluationAck {}))
    }

    async fn get_status(&self, _: Request<StatusRequest>) -> Result<Response<v1::Status>, Status> {
        Ok(Response::new(self.status.status()))
    }

    // Never called. tonic's generated trait requires these two methods, but `framing` answers their calls before tonic does.

    async fn send_unrolls(
        &self,
        _: Request<Streaming<UnrollMessage>>,
    ) -> Result<Response<Self::SendUnrollsStream>, Status> {
        Err(not_routed("SendUnrolls"))
    }

    async fn watch_parameters(
        &self,
        _: Request<WatchRequest>,
    ) -> Result<Response<Self::WatchParametersStream>, Status> {
        Err(not_routed("WatchParameters"))
    }
}

fn not_routed(call: &str) -> Status {
    Status::internal(format!("a defect of the learner: {call} reached tonic's service"))
}
