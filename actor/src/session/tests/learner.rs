//! A scripted learner.

use std::collections::HashSet;
use std::pin::Pin;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use comic_experiment::{Experiment, TaskSpec};
use comic_proto::v1::learner_server::{Learner, LearnerServer};
use comic_proto::v1::*;
use comic_proto::{UnrollLayout, UnrollShape};
use futures::{Stream, StreamExt as _};
use sha2::{Digest as _, Sha256};
use tokio::net::TcpListener;
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::{ReceiverStream, TcpListenerStream};
use tonic::{Request, Response, Status, Streaming};

pub(super) const ACTOR: u64 = 3;
/// The number of its run.
pub(super) const RUN: u64 = 8;
/// Bytes of parameters or assets in a message.
const PIECE: usize = 7;

/// How this learner differs from a real one.
#[derive(Clone, Debug, Default)]
pub(super) struct Script {
    /// For connection k: the number of unrolls it takes before it breaks, and how many of them it acknowledges.
    pub(super) breaks: Vec<(usize, usize)>,
    /// Takes unrolls and never acknowledges them.
    pub(super) silent: bool,
    /// Answers the first unroll as one of another learner epoch.
    pub(super) rejoin: bool,
    pub(super) refuse: bool,
    /// It sends every actor to this learner: host and port.
    pub(super) elsewhere: Option<String>,
    /// For so long after its start it has no place for an actor.
    pub(super) full_for: Duration,
    /// A newer process of the same name has joined.
    pub(super) superseded: bool,
    pub(super) wrong_layout: bool,
    /// The environments that it assigns to the actor in lockstep.
    pub(super) environments: Option<Environments>,
    pub(super) lockstep: bool,
    pub(super) asset: Option<Vec<u8>>,
    /// Bytes that it sends instead of the asset.
    pub(super) asset_sent: Option<Vec<u8>>,
}

/// What this learner received.
#[derive(Clone, Debug, Default)]
pub(super) struct Seen {
    pub(super) joins: Vec<JoinRequest>,
    /// Sequence number and version of each unroll at its first arrival.
    pub(super) taken: Vec<(u64, u64)>,
    pub(super) assets: usize,
}

struct Inner {
    script: Script,
    started: Instant,
    seen: watch::Sender<Seen>,
    numbers: Mutex<HashSet<u64>>,
    connections: AtomicUsize,
    experiment: Mutex<Experiment>,
    parameters: watch::Sender<Vec<ParametersChunk>>,
}

#[derive(Clone)]
pub(super) struct FakeLearner {
    inner: Arc<Inner>,
    address: String,
}

impl FakeLearner {
    pub(super) async fn start(script: Script) -> Self {
        Self::serve(TcpListener::bind("127.0.0.1:0").await.unwrap(), script)
    }

    pub(super) fn serve(listener: TcpListener, script: Script) -> Self {
        let address = format!("http://{}", listener.local_addr().unwrap());
        let inner = Arc::new(Inner {
            script,
            started: Instant::now(),
            seen: watch::Sender::default(),
            numbers: Mutex::default(),
            connections: AtomicUsize::new(0),
            experiment: Mutex::default(),
            parameters: watch::Sender::default(),
        });
        let learner = Self { inner, address };
        let router = tonic::transport::Server::builder().add_service(LearnerServer::new(learner.clone()));
        tokio::spawn(router.serve_with_incoming(TcpListenerStream::new(listener)));
        learner
    }

    pub(super) fn address(&self) -> String {
        self.address.clone()
    }

    pub(super) fn seen(&self) -> Seen {
        self.inner.seen.borrow().clone()
    }

    pub(super) async fn until(&self, condition: impl Fn(&Seen) -> bool) {
        self.inner.seen.subscribe().wait_for(|seen| condition(seen)).await.unwrap();
    }

    pub(super) fn change_experiment(&self) {
        self.inner.experiment.lock().unwrap().seed += 1;
    }

    pub(super) fn publish(&self, version: u64, parameters: &[u8]) {
        self.send_parameters(version, parameters, false);
    }

    pub(super) fn end_run(&self, version: u64) {
        self.send_parameters(version, &[], true);
    }

    fn send_parameters(&self, version: u64, parameters: &[u8], run_over: bool) {
        let total = parameters.len() as u64;
        let piece = |(index, data): (usize, &[u8])| ParametersChunk {
            learner_epoch: 1,
            version,
            total,
            offset: (index * PIECE) as u64,
            data: data.to_vec().into(),
            run_over,
        };
        let mut pieces: Vec<_> = parameters.chunks(PIECE).enumerate().map(piece).collect();
        if pieces.is_empty() {
            pieces.push(piece((0, &[])));
        }
        self.inner.parameters.send_replace(pieces);
    }

    /// The script's asset, as it is announced.
    fn asset(&self) -> Option<Asset> {
        let bytes = self.inner.script.asset.as_ref()?;
        Some(Asset { source: "walks.h5".into(), sha256: Sha256::digest(bytes).to_vec(), size: bytes.len() as u64 })
    }

    /// Takes an unroll; the second time it is a duplicate.
    fn take(&self, header: &UnrollHeader) -> Verdict {
        if !self.inner.numbers.lock().unwrap().insert(header.sequence) {
            return Verdict::Duplicate;
        }
        self.inner.seen.send_modify(|seen| seen.taken.push((header.sequence, header.version)));
        Verdict::Taken
    }
}

type Reply<T> = Result<Response<T>, Status>;
type BoxStream<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

#[tonic::async_trait]
impl Learner for FakeLearner {
    async fn join(&self, request: Request<JoinRequest>) -> Reply<JoinReply> {
        if self.inner.script.refuse {
            return Err(Status::failed_precondition("another protocol"));
        }
        if self.inner.started.elapsed() < self.inner.script.full_for {
            return Err(Status::resource_exhausted("all places are taken"));
        }
        self.inner.seen.send_modify(|seen| seen.joins.push(request.into_inner()));
        if self.inner.script.superseded {
            return Err(Status::aborted("a newer process"));
        }
        if let Some(learner) = self.inner.script.elsewhere.clone() {
            return Ok(Response::new(JoinReply { learner, ..JoinReply::default() }));
        }
        let mut experiment = self.inner.experiment.lock().unwrap().clone();
        if self.inner.script.lockstep {
            (experiment.unroll.lockstep, experiment.unroll.ahead) = (true, 0);
        }
        let spec = TaskSpec::new(&experiment, vec!["walk".into()]).unwrap();
        let layout = UnrollLayout::new(UnrollShape::new(&spec, &experiment));
        let layout_hash = if self.inner.script.wrong_layout { vec![0; 32] } else { layout.hash().to_vec() };
        Ok(Response::new(JoinReply {
            learner_epoch: 1,
            actor: ACTOR,
            seed: 11,
            experiment: experiment.to_toml().unwrap(),
            task_spec: toml::to_string(&spec).unwrap(),
            assets: self.asset().into_iter().collect(),
            layout_hash,
            next_sequence: 0,
            environments: self.inner.script.environments,
            run: RUN,
            learner: String::new(),
        }))
    }

    type FetchAssetStream = BoxStream<AssetChunk>;
    async fn fetch_asset(&self, _request: Request<AssetRequest>) -> Reply<Self::FetchAssetStream> {
        self.inner.seen.send_modify(|seen| seen.assets += 1);
        let script = &self.inner.script;
        let sent = script.asset_sent.clone().or(script.asset.clone()).unwrap();
        let pieces: Vec<_> = sent.chunks(PIECE).map(|data| Ok(AssetChunk { data: data.to_vec().into() })).collect();
        Ok(Response::new(Box::pin(futures::stream::iter(pieces))))
    }

    type SendUnrollsStream = ReceiverStream<Result<UnrollAck, Status>>;
    async fn send_unrolls(&self, request: Request<Streaming<UnrollMessage>>) -> Reply<Self::SendUnrollsStream> {
        let connection = self.inner.connections.fetch_add(1, Ordering::Relaxed);
        let breaks = self.inner.script.breaks.get(connection).copied();
        let (acks, stream) = mpsc::channel(1);
        let learner = self.clone();
        let mut unrolls = request.into_inner();
        tokio::spawn(async move {
            let mut count = 0;
            loop {
                if breaks.is_some_and(|(taken, _)| count == taken) {
                    let _ = acks.send(Err(Status::unavailable("broken on purpose"))).await;
                    return;
                }
                let Ok(Some(message)) = unrolls.message().await else { return };
                let header = message.header.unwrap();
                let verdict = learner.take(&header);
                count += 1;
                if learner.inner.script.silent || breaks.is_some_and(|(_, acknowledged)| count > acknowledged) {
                    continue;
                }
                let rejoin = learner.inner.script.rejoin && header.sequence == 0;
                let (verdict, learner_epoch) = if rejoin { (Verdict::Rejoin, 2) } else { (verdict, 1) };
                let sequence = header.sequence;
                let ack = UnrollAck { sequence, verdict: verdict.into(), learner_epoch, ..UnrollAck::default() };
                if acks.send(Ok(ack)).await.is_err() {
                    return;
                }
            }
        });
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    type WatchParametersStream = BoxStream<ParametersChunk>;
    async fn watch_parameters(&self, _request: Request<WatchRequest>) -> Reply<Self::WatchParametersStream> {
        let mut receiver = self.inner.parameters.subscribe();
        receiver.mark_changed();
        let versions = futures::stream::unfold(receiver, |mut receiver| async {
            receiver.changed().await.ok()?;
            let pieces = receiver.borrow_and_update().clone();
            Some((futures::stream::iter(pieces.into_iter().map(Ok)), receiver))
        });
        Ok(Response::new(Box::pin(versions.flatten())))
    }

    async fn get_checkpoint(&self, _request: Request<CheckpointRequest>) -> Reply<CheckpointReply> {
        let asset = self.asset();
        let (experiment, policy, assets) = (asset.clone(), asset.clone(), asset.into_iter().collect());
        let checkpoint = Checkpoint { run: RUN, updates: 1, experiment, policy, assets, ..Checkpoint::default() };
        Ok(Response::new(CheckpointReply { checkpoint: Some(checkpoint), run_over: false }))
    }

    async fn report_evaluation(&self, _request: Request<EvaluationReport>) -> Reply<EvaluationAck> {
        Err(Status::unimplemented("no evaluations here"))
    }

    async fn get_status(&self, _request: Request<StatusRequest>) -> Reply<comic_proto::v1::Status> {
        Err(Status::unimplemented("no status here"))
    }
}
