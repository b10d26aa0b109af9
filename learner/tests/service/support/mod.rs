//! A learner's service on a loopback port, and a real client of it.
#![allow(dead_code, clippy::unwrap_used, clippy::expect_used)]

use std::convert::Infallible;
use std::future::poll_fn;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Result;
use bytes::Bytes;
use comic_clips::Asset;
use comic_experiment::{Experiment, TaskPart, TaskSpec, Unroll};
use comic_learner::observe::probes::Probed as _;
use comic_learner::publish::Publisher;
use comic_learner::security::{ConnectionLimits, Security};
use comic_learner::service::quarantine::QuarantineArguments;
use comic_learner::service::{Service, Setup, serve};
use comic_proto::v1::learner_client::LearnerClient;
use comic_proto::v1::{
    JoinReply, JoinRequest, ParametersChunk, StatusRequest, UnrollAck, UnrollHeader, UnrollMessage, Verdict,
    WatchRequest,
};
use comic_proto::{Access, Client, Field, PROTOCOL_VERSION, UnrollBuffer, UnrollLayout, UnrollShape};
use comic_replay::{BatchOrder, Batcher, Config, Ledger, Phase};
use futures::{Stream, StreamExt as _};
use http::{Request, Response};
use http_body::Frame;
use http_body_util::StreamBody;
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio_stream::wrappers::ReceiverStream;
use tonic::body::Body;
use tonic::transport::Channel;
use tonic::{Status, Streaming};
use tower::Service as _;

pub(crate) const EPOCH: u64 = 3;
/// The run's number.
pub(crate) const RUN: u64 = 0x5eed;
/// Unrolls of a batch.
pub(crate) const BATCH: usize = 2;

/// A learner that serves and has no trainer.
pub(crate) struct World {
    pub(crate) experiment: Experiment,
    pub(crate) spec: TaskSpec,
    pub(crate) batcher: Batcher,
    pub(crate) publisher: Publisher,
    pub(crate) service: Service,
    pub(crate) address: String,
    shutdown: Option<oneshot::Sender<()>>,
    server: JoinHandle<comic_learner::error::Result<()>>,
}

impl World {
    pub(crate) async fn start() -> Self {
        Self::start_with(8, Vec::new()).await
    }

    /// With this size of proprioception, and these assets.
    pub(crate) async fn start_with(proprioception: usize, assets: Vec<Asset>) -> Self {
        Self::guarded(proprioception, assets, Security::default(), ConnectionLimits::default()).await
    }

    /// With these limits.
    pub(crate) async fn limited(limits: ConnectionLimits) -> Self {
        Self::guarded(8, Vec::new(), Security::default(), limits).await
    }

    /// With certificates and tokens.
    pub(crate) async fn secured(security: Security) -> Self {
        Self::guarded(8, Vec::new(), security, ConnectionLimits::default()).await
    }

    /// With a quarantine.
    pub(crate) async fn quarantining(quarantine: QuarantineArguments) -> Self {
        Self::of(experiment(), 8, Vec::new(), Security::default(), ConnectionLimits::default(), quarantine).await
    }

    /// In lockstep, with so many environments.
    pub(crate) async fn in_lockstep(environments: usize) -> Self {
        let mut experiment = experiment();
        experiment.unroll = Unroll { lockstep: true, ahead: 0, batch: environments, ..experiment.unroll };
        let (security, limits, quarantine) =
            (Security::default(), ConnectionLimits::default(), QuarantineArguments::default());
        Self::of(experiment, 8, Vec::new(), security, limits, quarantine).await
    }

    /// With all of these.
    pub(crate) async fn guarded(
        proprioception: usize,
        assets: Vec<Asset>,
        security: Security,
        limits: ConnectionLimits,
    ) -> Self {
        Self::of(experiment(), proprioception, assets, security, limits, QuarantineArguments::default()).await
    }

    async fn of(
        experiment: Experiment,
        proprioception: usize,
        assets: Vec<Asset>,
        security: Security,
        limits: ConnectionLimits,
        quarantine: QuarantineArguments,
    ) -> Self {
        let spec = TaskSpec {
            proprioception,
            task: 3,
            action: 2,
            reward_terms: vec!["posture".into(), "progress".into()],
            image: 0,
            clips: vec!["walk".into(), "run".into()],
            tasks: vec![TaskPart { name: "tracking".into(), observation: 3, clips: 2, max_reward: 1.0 }],
        };
        let layout = Arc::new(UnrollLayout::new(UnrollShape::new(&spec, &experiment)));
        let config = Config { unrolls: BATCH, max_staleness: 5, ahead: 2, order: BatchOrder::Arrival };
        let phase = Phase { epoch: EPOCH, version: 0, oldest: 0 };
        let batcher = Batcher::new(layout, config, phase, Ledger::new());
        let publisher = Publisher::new(EPOCH);
        let setup = Setup {
            run: "runs/test".into(),
            id: RUN,
            security,
            limits,
            experiment: experiment.clone(),
            spec: spec.clone(),
            assets,
            batcher: batcher.clone(),
            publisher: publisher.clone(),
            quarantine,
            placement: None,
        };
        let service = Service::new(setup).unwrap();
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let (shutdown, signal) = oneshot::channel::<()>();
        let server = tokio::spawn(serve(listener, service.clone(), async move {
            let _ = signal.await;
        }));
        Self { experiment, spec, batcher, publisher, service, address, shutdown: Some(shutdown), server }
    }

    /// A connection, for clients of other services.
    pub(crate) async fn channel(&self) -> Channel {
        Channel::from_shared(self.address.clone()).unwrap().connect().await.unwrap()
    }

    /// Sends these frames as a stream of unrolls, and returns the answer.
    pub(crate) async fn send_frames(&self, frames: impl Stream<Item = Bytes> + Send + 'static) -> Response<Body> {
        let body = StreamBody::new(frames.map(|data| Ok::<_, Infallible>(Frame::data(data))));
        let request = Request::post(format!("{}/comic.v1.Learner/SendUnrolls", self.address))
            .header("content-type", "application/grpc")
            .header("te", "trailers")
            .body(Body::new(body))
            .unwrap();
        let mut channel = self.channel().await;
        poll_fn(|context| channel.poll_ready(context)).await.unwrap();
        channel.call(request).await.unwrap()
    }

    /// A client on a connection of its own.
    pub(crate) async fn client(&self) -> LearnerClient<Channel> {
        LearnerClient::connect(self.address.clone()).await.unwrap()
    }

    /// A client with this access, or the error that prevents it.
    pub(crate) async fn client_with(&self, access: &Access) -> Result<Client> {
        let scheme = if access.ca.is_some() { "https://localhost" } else { "http://127.0.0.1" };
        let port = self.address.rsplit(':').next().unwrap();
        let channel = access.endpoint(&format!("{scheme}:{port}"))?.connect().await?;
        Ok(LearnerClient::with_interceptor(channel, access.bearer()?))
    }

    /// An actor that has joined.
    pub(crate) async fn actor(&self, incarnation: u64) -> Actor {
        self.named_actor(incarnation, "").await
    }

    /// An actor that has joined, of this name.
    pub(crate) async fn named_actor(&self, incarnation: u64, name: &str) -> Actor {
        let mut client = self.client().await;
        let request = JoinRequest { name: name.into(), ..joining(incarnation) };
        let reply = client.join(request).await.unwrap().into_inner();
        Actor { client, reply, incarnation, layout: self.batcher.layout().clone() }
    }

    /// The metrics, as Prometheus reads them.
    pub(crate) fn metrics_page(&self) -> String {
        self.service.probed().metrics_page()
    }

    /// Gives the shutdown signal.
    pub(crate) fn begin_shutdown(&mut self) {
        let _ = self.shutdown.take().unwrap().send(());
    }

    /// What [`serve`] returned after the signal.
    pub(crate) async fn ended(self) -> comic_learner::error::Result<()> {
        within(Duration::from_secs(20), self.server).await.unwrap()
    }
}

fn experiment() -> Experiment {
    let mut experiment = Experiment::default();
    experiment.unroll.length = 4;
    experiment.unroll.batch = BATCH;
    experiment.vmpo.minibatch_unrolls = BATCH;
    experiment.network.latent.size = 2;
    experiment
}

/// The request of a new process.
pub(crate) fn joining(incarnation: u64) -> JoinRequest {
    JoinRequest { incarnation, protocol: PROTOCOL_VERSION, ..JoinRequest::default() }
}

pub(crate) struct Actor {
    pub(crate) client: LearnerClient<Channel>,
    pub(crate) reply: JoinReply,
    pub(crate) incarnation: u64,
    pub(crate) layout: Arc<UnrollLayout>,
}

impl Actor {
    /// A valid unroll.
    pub(crate) fn unroll(&self, sequence: u64) -> UnrollMessage {
        let header = UnrollHeader {
            actor: self.reply.actor,
            incarnation: self.incarnation,
            sequence,
            learner_epoch: self.reply.learner_epoch,
            version: 0,
            layout_hash: self.layout.hash().to_vec(),
            episodes: Vec::new(),
            environment: 0,
            task: 0,
        };
        let mut unroll = UnrollBuffer::new(&self.layout);
        for t in 0..self.layout.shape().length {
            unroll.row_mut(Field::Valid, t).fill(1.0);
            unroll.row_mut(Field::Discount, t).fill(1.0);
            unroll.row_mut(Field::Reward, t).fill(sequence as f32);
        }
        UnrollMessage { header: Some(header), payload: unroll.into_bytes() }
    }

    /// An unroll with a changed header.
    pub(crate) fn unroll_with(&self, sequence: u64, change: impl FnOnce(&mut UnrollHeader)) -> UnrollMessage {
        let mut unroll = self.unroll(sequence);
        change(unroll.header.as_mut().unwrap());
        unroll
    }

    /// Opens the stream of unrolls.
    pub(crate) async fn stream(&mut self) -> Unrolls {
        let (sender, receiver) = mpsc::channel(1);
        let acks = self.client.send_unrolls(ReceiverStream::new(receiver)).await.unwrap().into_inner();
        Unrolls { sender, acks }
    }

    /// Opens the stream of parameters.
    pub(crate) async fn watch(&mut self) -> Streaming<ParametersChunk> {
        let request = WatchRequest { actor: self.reply.actor, incarnation: self.incarnation };
        self.client.watch_parameters(request).await.unwrap().into_inner()
    }

    pub(crate) async fn accounting(&mut self) -> comic_proto::v1::Accounting {
        self.client.get_status(StatusRequest {}).await.unwrap().into_inner().accounting.unwrap()
    }
}

/// A stream of unrolls and their acknowledgements.
pub(crate) struct Unrolls {
    pub(crate) sender: mpsc::Sender<UnrollMessage>,
    pub(crate) acks: Streaming<UnrollAck>,
}

impl Unrolls {
    /// Sends an unroll and waits for its answer.
    pub(crate) async fn send(&mut self, unroll: UnrollMessage) -> Result<UnrollAck, Status> {
        // The stream may have ended already; the answer then says why.
        let _ = self.sender.send(unroll).await;
        let answer = within(Duration::from_secs(10), self.acks.message()).await?;
        Ok(answer.expect("an acknowledgement"))
    }

    /// The verdict on an unroll.
    pub(crate) async fn verdict(&mut self, unroll: UnrollMessage) -> Verdict {
        self.send(unroll).await.unwrap().verdict()
    }
}

/// Fails the test when something takes longer than the limit.
pub(crate) async fn within<T>(limit: Duration, future: impl Future<Output = T>) -> T {
    tokio::time::timeout(limit, future).await.expect("in time")
}

/// A payload that depends on its version.
pub(crate) fn parameters(version: u64, size: usize) -> Bytes {
    Bytes::from(vec![version as u8; size])
}
