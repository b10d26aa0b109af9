//! The service with a stand-in for the trainer, and the two floors.

use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};
use bytes::Bytes;
use clap::{Args, ValueEnum};
use comic_learner::publish::Publisher;
use comic_learner::security::{ConnectionLimits, Security, Tls, Tokens};
use comic_learner::service::http2::{server, window};
use comic_learner::service::process::{allow_descriptors, runtime};
use comic_learner::service::quarantine::QuarantineArguments;
use comic_learner::service::{Service, Setup, serve};
use comic_proto::v1::learner_server::{Learner, LearnerServer};
use comic_proto::v1::{self, UnrollAck, UnrollMessage, Verdict};
use comic_replay::{BatchOrder, Batcher, Config, Ledger, Next, Phase};
use futures::stream::{self, BoxStream, StreamExt as _};
use serde_json::{Value, json};
use tokio::io::AsyncWriteExt as _;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status, Streaming};

use super::paper::{experiment, positive};
use super::process::answer_requests;

const EPOCH: u64 = 1;

/// Run a server
#[derive(Debug, Args)]
pub struct Host {
    #[arg(long, value_enum)]
    kind: Kind,
    /// Bytes of a version
    #[arg(long, default_value_t = 0)]
    parameters: usize,
    /// Seconds between versions; without it a version is published only on request
    #[arg(long, value_parser = positive)]
    publish_every: Option<f64>,
    /// Seconds of an update
    #[arg(long, value_parser = positive)]
    update: Option<f64>,
    /// Serve by TLS, and require the token, with what `comic-learner certs` made in this directory
    #[arg(long)]
    tls: Option<PathBuf>,
    /// Updates between versions
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    target_period: Option<u64>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Kind {
    /// The learner's service.
    Learner,
    /// A stream of unrolls that drops what it reads.
    Tonic,
    /// Sockets to which the host writes.
    Sockets,
}

impl Host {
    /// Serves, and answers requests on standard input until it ends.
    ///
    /// # Errors
    /// An address that cannot be used; standard input or output that fails.
    pub fn run(&self) -> Result<()> {
        let runtime = runtime()?;
        let listener = runtime.block_on(TcpListener::bind((Ipv4Addr::LOCALHOST, 0)))?;
        println!("{}", json!({ "listening": listener.local_addr()?.to_string() }));
        match self.kind {
            Kind::Learner => {
                let stand_in = StandIn::new(self)?;
                runtime.spawn(serve(listener, stand_in.service.clone(), std::future::pending()));
                stand_in.start(self)?;
                answer_requests(|request| stand_in.answer(request))
            }
            Kind::Tonic => {
                let bytes = Arc::<AtomicU64>::default();
                let layout = experiment()?.2;
                let service = LearnerServer::new(Bare(bytes.clone())).max_decoding_message_size(layout.message_limit());
                let incoming = TcpListenerStream::new(listener).inspect(|socket| {
                    let _ = socket.as_ref().map(|socket| socket.set_nodelay(true));
                });
                runtime.spawn(server(window(&layout)).add_service(service).serve_with_incoming(incoming));
                answer_requests(|_| json!({ "bytes": bytes.load(Relaxed) }))
            }
            Kind::Sockets => {
                let (newest, versions) = watch::channel(0_u64);
                runtime.spawn(write_to_all(listener, versions, Bytes::from(vec![1; self.parameters])));
                answer_requests(|request| {
                    if request == "publish" {
                        newest.send_modify(|version| *version += 1);
                    }
                    json!({})
                })
            }
        }
    }
}

/// The learner with a thread that takes batches in place of the trainer.
#[derive(Clone, Debug)]
struct StandIn {
    service: Service,
    batcher: Batcher,
    publisher: Publisher,
    payload: Bytes,
}

impl StandIn {
    fn new(options: &Host) -> Result<Self> {
        let (experiment, spec, layout) = experiment()?;
        let config = Config {
            unrolls: experiment.unroll.batch,
            max_staleness: experiment.max_versions_late(),
            ahead: experiment.unroll.ahead,
            order: BatchOrder::Arrival,
        };
        let batcher = Batcher::new(Arc::new(layout), config, Phase::begin(EPOCH), Ledger::new());
        let publisher = Publisher::new(EPOCH);
        let limits = ConnectionLimits {
            max_actors: 65_536,
            max_connections_per_address: Some(65_536),
            max_requests: 262_144,
            ..ConnectionLimits::default()
        };
        allow_descriptors(16_384);
        let service = Service::new(Setup {
            run: "runs/bench".into(),
            id: 0,
            security: security(options.tls.as_deref())?,
            limits,
            experiment,
            spec,
            assets: Vec::new(),
            batcher: batcher.clone(),
            publisher: publisher.clone(),
            quarantine: QuarantineArguments::default(),
            placement: None,
        })?;
        Ok(Self { service, batcher, publisher, payload: Bytes::from(vec![1; options.parameters]) })
    }

    fn start(&self, options: &Host) -> Result<()> {
        if let Some(every) = options.publish_every {
            let stand_in = self.clone();
            spawn("publishing", move || {
                loop {
                    stand_in.publish();
                    thread::sleep(Duration::from_secs_f64(every));
                }
            })?;
        }
        if options.target_period.is_some() {
            self.publish();
        }
        let (stand_in, update, period) =
            (self.clone(), Duration::from_secs_f64(options.update.unwrap_or_default()), options.target_period);
        spawn("training", move || stand_in.train(update, period))
    }

    fn train(&self, update: Duration, period: Option<u64>) {
        let mut updates = 0;
        loop {
            match self.batcher.next_batch_within(Duration::from_secs(1)) {
                Next::Batch(batch) => {
                    let began = Instant::now();
                    thread::sleep(update);
                    updates += 1;
                    let newest = self.publisher.newest_version();
                    let ages = batch.headers().iter().map(|header| newest.saturating_sub(header.version)).collect();
                    if period.is_some_and(|period| u64::is_multiple_of(updates, period)) {
                        self.publish();
                    }
                    self.batcher.trained(batch);
                    self.service.trainer().prometheus.count_update(began.elapsed(), ages);
                }
                Next::Elapsed => {}
                Next::Closed => return,
            }
        }
    }

    fn publish(&self) {
        let version = self.publisher.newest_version() + 1;
        self.batcher.set_phase(Phase { version, ..self.batcher.phase() });
        self.publisher.publish(version, &self.payload);
    }

    fn answer(&self, request: &str) -> Value {
        if request == "publish" {
            self.publish();
        }
        let accounting = self.batcher.accounting();
        json!({
            "bytes": accounting.trained * self.batcher.layout().size() as u64,
            "version": self.publisher.newest_version(),
            "trained": accounting.trained,
            "balanced": accounting.balance(),
            "accounting": accounting,
        })
    }
}

/// TLS and a token where they are asked for.
fn security(certificates: Option<&Path>) -> Result<Security> {
    let Some(directory) = certificates else { return Ok(Security::default()) };
    let tls = Tls::new(&directory.join("server.pem"), &directory.join("server-key.pem"), None)?;
    Ok(Security { tls: Some(tls), tokens: Tokens::new(Some(&directory.join("token")))? })
}

fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> Result<()> {
    thread::Builder::new().name(name.into()).spawn(work).map(drop).context("cannot start a thread")
}

/// A service that counts the bytes of unrolls and does nothing else.
#[derive(Debug)]
struct Bare(Arc<AtomicU64>);

type Answers<T> = BoxStream<'static, Result<T, Status>>;

#[tonic::async_trait]
impl Learner for Bare {
    type FetchAssetStream = Answers<v1::AssetChunk>;
    type SendUnrollsStream = Answers<UnrollAck>;
    type WatchParametersStream = Answers<v1::ParametersChunk>;

    async fn send_unrolls(
        &self,
        request: Request<Streaming<UnrollMessage>>,
    ) -> Result<Response<Self::SendUnrollsStream>, Status> {
        let read = (request.into_inner(), self.0.clone());
        Ok(Response::new(
            stream::unfold(read, |(mut unrolls, bytes)| async {
                let UnrollMessage { header, payload } = unrolls.message().await.ok().flatten()?;
                bytes.fetch_add(payload.len() as u64, Relaxed);
                let sequence = header.map_or(0, |header| header.sequence);
                Some((
                    Ok(UnrollAck { sequence, verdict: Verdict::Taken.into(), ..UnrollAck::default() }),
                    (unrolls, bytes),
                ))
            })
            .boxed(),
        ))
    }

    async fn join(&self, _: Request<v1::JoinRequest>) -> Result<Response<v1::JoinReply>, Status> {
        Err(Status::unimplemented("join"))
    }

    async fn fetch_asset(&self, _: Request<v1::AssetRequest>) -> Result<Response<Self::FetchAssetStream>, Status> {
        Err(Status::unimplemented("fetch_asset"))
    }

    async fn watch_parameters(
        &self,
        _: Request<v1::WatchRequest>,
    ) -> Result<Response<Self::WatchParametersStream>, Status> {
        Err(Status::unimplemented("watch_parameters"))
    }

    async fn get_checkpoint(&self, _: Request<v1::CheckpointRequest>) -> Result<Response<v1::CheckpointReply>, Status> {
        Err(Status::unimplemented("get_checkpoint"))
    }

    async fn report_evaluation(&self, _: Request<v1::EvaluationReport>) -> Result<Response<v1::EvaluationAck>, Status> {
        Err(Status::unimplemented("report_evaluation"))
    }

    async fn get_status(&self, _: Request<v1::StatusRequest>) -> Result<Response<v1::Status>, Status> {
        Err(Status::unimplemented("get_status"))
    }
}

async fn write_to_all(listener: TcpListener, versions: watch::Receiver<u64>, payload: Bytes) {
    while let Ok((mut socket, _)) = listener.accept().await {
        let (mut versions, payload) = (versions.clone(), payload.clone());
        tokio::spawn(async move {
            let _ = socket.set_nodelay(true);
            // The greeting: a client that reads it was accepted.
            if socket.write_u8(0).await.is_err() {
                return;
            }
            while versions.changed().await.is_ok() && socket.write_all(&payload).await.is_ok() {}
        });
    }
}
