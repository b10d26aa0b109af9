//! Many actors in one process.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use bytes::Bytes;
use clap::{Args, ValueEnum};
use comic_experiment::{Experiment, TaskSpec};
use comic_proto::v1::learner_client::LearnerClient;
use comic_proto::v1::{JoinReply, JoinRequest, ParametersChunk, Verdict, WatchRequest};
use comic_proto::{Access, Field, PROTOCOL_VERSION, UnrollBuffer, UnrollLayout, UnrollShape};
use rand::rngs::StdRng;
use rand::{Rng as _, SeedableRng as _};
use serde_json::{Value, json};
use tokio::io::AsyncReadExt as _;
use tokio::net::TcpStream;
use tokio::sync::{Semaphore, mpsc};
use tokio::time::{sleep, sleep_until};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status};

use super::identity::Identity;
use super::process::obey;
use super::reader;

/// Connections that are made at the same time.
const CONNECTING: usize = 64;
/// How long an actor that churns stalls.
const STALL: std::ops::Range<f64> = 5.0..60.0;
/// After a failure, or between two lives.
const PAUSE: Duration = Duration::from_secs(2);
const FOREVER: Duration = Duration::from_secs(86_400 * 365);

#[derive(Clone, Debug, Args)]
pub(super) struct Options {
    #[arg(long)]
    host: String,
    #[arg(long, value_enum, default_value_t = Kind::Grpc)]
    kind: Kind,
    #[arg(long)]
    actors: usize,
    /// Unrolls that an actor has under way; none are sent otherwise.
    #[arg(long, default_value_t = 0)]
    window: usize,
    /// Read parameters.
    #[arg(long)]
    watch: bool,
    /// Stop reading for ever, each actor in another one of so many versions.
    #[arg(long)]
    stall_within: Option<u64>,
    /// Mean seconds of an actor's life, and between its stalls.
    #[arg(long, value_parser = super::positive)]
    churn: Option<f64>,
    /// Reach the learner by TLS, with the authority that `comic-learner certs` made there.
    #[arg(long)]
    tls: Option<PathBuf>,
    /// Bytes of a version, where only sockets are read.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    parameters: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// Actors of a learner.
    Grpc,
    /// Streams of unrolls to somebody who drops them.
    BareGrpc,
    /// Readers of parameters that drop every byte.
    Readers,
    /// Bytes from a socket.
    Sockets,
}

impl Options {
    pub(super) fn run(&self) -> Result<()> {
        let crowd = Arc::new(Crowd::new(self)?);
        crate::service::process::allow_descriptors(self.actors as u64 + 256);
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
        for index in 0..self.actors {
            runtime.spawn(crowd.clone().actor(index));
        }
        obey(|order| {
            if order == "forget" {
                crowd.forget();
            }
            crowd.stats()
        })
    }
}

/// What all of them share.
#[derive(Debug)]
struct Crowd {
    options: Options,
    /// A valid unroll of the experiment that the first of them was told, and its layout's hash.
    unroll: OnceLock<(Bytes, Vec<u8>)>,
    doors: Semaphore,
    start: Instant,
    connected: AtomicU64,
    lives: AtomicU64,
    stalled: AtomicU64,
    failures: AtomicU64,
    acked: AtomicU64,
    taken: AtomicU64,
    stale: AtomicU64,
    bytes: AtomicU64,
    versions: AtomicU64,
    newest: AtomicU64,
    lags: Mutex<Lags>,
    /// Of each actor: since when it waits for an acknowledgement and for a version, milliseconds from the start, or
    /// [`NEVER`].
    waits: Vec<[AtomicU64; 2]>,
    longest: [AtomicU64; 2],
}

const NEVER: u64 = u64::MAX;

/// How old versions were when they had come.
#[derive(Debug, Default)]
struct Lags {
    versions: Vec<f64>,
    seconds: Vec<f64>,
    /// When anybody first heard of a version.
    announced: Vec<Option<Instant>>,
}

impl Crowd {
    fn new(options: &Options) -> Result<Self> {
        Ok(Self {
            unroll: OnceLock::new(),
            doors: Semaphore::new(CONNECTING),
            start: Instant::now(),
            connected: AtomicU64::default(),
            lives: AtomicU64::default(),
            stalled: AtomicU64::default(),
            failures: AtomicU64::default(),
            acked: AtomicU64::default(),
            taken: AtomicU64::default(),
            stale: AtomicU64::default(),
            bytes: AtomicU64::default(),
            versions: AtomicU64::default(),
            newest: AtomicU64::default(),
            lags: Mutex::default(),
            waits: (0..options.actors).map(|_| [const { AtomicU64::new(NEVER) }; 2]).collect(),
            longest: Default::default(),
            options: options.clone(),
        })
    }

    fn unroll(&self, reply: &JoinReply) -> Result<&(Bytes, Vec<u8>)> {
        if let Some(unroll) = self.unroll.get() {
            return Ok(unroll);
        }
        let layout = match self.options.kind {
            Kind::Grpc => {
                let experiment = Experiment::from_toml("the learner's experiment", &reply.experiment)?;
                let spec: TaskSpec = toml::from_str(&reply.task_spec)?;
                UnrollLayout::new(UnrollShape::new(&spec, &experiment))
            }
            _ => super::experiment()?.2,
        };
        let mut unroll = UnrollBuffer::new(&layout);
        for t in 0..layout.shape().length {
            unroll.row_mut(Field::Valid, t).fill(1.0);
            unroll.row_mut(Field::Discount, t).fill(1.0);
        }
        Ok(self.unroll.get_or_init(|| (unroll.into_bytes(), layout.hash().to_vec())))
    }

    fn stats(&self) -> Value {
        let now = self.now();
        for waits in &self.waits {
            for (since, longest) in waits.iter().zip(&self.longest) {
                longest.fetch_max(now.saturating_sub(since.load(Relaxed)), Relaxed);
            }
        }
        let lags = self.lags.lock().unwrap_or_else(PoisonError::into_inner);
        let [ack, version] = &self.longest;
        json!({
            "connected": self.connected.load(Relaxed),
            "lives": self.lives.load(Relaxed),
            "stalled": self.stalled.load(Relaxed),
            "failures": self.failures.load(Relaxed),
            "acked": self.acked.load(Relaxed),
            "taken": self.taken.load(Relaxed),
            "stale": self.stale.load(Relaxed),
            "bytes": self.bytes.load(Relaxed),
            "versions": self.versions.load(Relaxed),
            "lag_versions": quantiles(&lags.versions),
            "lag_seconds": quantiles(&lags.seconds),
            "longest_without_an_acknowledgement": ack.load(Relaxed) as f64 / 1e3,
            "longest_without_a_version": version.load(Relaxed) as f64 / 1e3,
        })
    }

    /// What has been measured so far does not count.
    fn forget(&self) {
        let mut lags = self.lags.lock().unwrap_or_else(PoisonError::into_inner);
        (lags.versions, lags.seconds) = (Vec::new(), Vec::new());
        self.longest.iter().for_each(|longest| longest.store(0, Relaxed));
    }

    fn now(&self) -> u64 {
        self.start.elapsed().as_millis() as u64
    }

    /// Notes the end of a wait and the beginning of the next.
    fn waited(&self, index: usize, what: usize) {
        let now = self.now();
        let since = self.waits[index][what].swap(now, Relaxed);
        self.longest[what].fetch_max(now.saturating_sub(since), Relaxed);
    }

    /// Does not wait any more, or begins to.
    fn wait_from(&self, index: usize, since: [u64; 2]) {
        for (wait, since) in self.waits[index].iter().zip(since) {
            wait.store(since, Relaxed);
        }
    }

    async fn actor(self: Arc<Self>, index: usize) {
        let mut rng = StdRng::seed_from_u64(index as u64);
        let mut identity = Identity::new(None);
        loop {
            let lived = match self.options.kind {
                Kind::Sockets => self.read_socket().await,
                Kind::Readers => self.read_frames(index as u64).await,
                Kind::Grpc | Kind::BareGrpc => self.live(index, &mut identity, &mut rng).await,
            };
            self.wait_from(index, [NEVER; 2]);
            match lived {
                Ok(()) => identity = Identity::new(identity.actor),
                Err(error) if self.failures.fetch_add(1, Relaxed) < 10 => {
                    eprintln!("actor {index} of the crowd: {error:#}");
                }
                Err(_) => {}
            }
            sleep(PAUSE.mul_f64(rng.random_range(0.5..2.0))).await;
        }
    }

    async fn read_socket(&self) -> Result<()> {
        let mut socket = self.connect().await?;
        // The host's greeting: a connection that the system made may still wait to be accepted, or have been lost there.
        socket.read_u8().await?;
        let _present = Present::new(&self.connected);
        let (mut buffer, mut read) = (vec![0; 64 * 1024], 0);
        loop {
            let more = socket.read(&mut buffer).await?;
            ensure!(more > 0, "the host ended the connection");
            self.count(&mut read, more as u64);
        }
    }

    async fn connect(&self) -> Result<TcpStream> {
        let _door = self.doors.acquire().await?;
        Ok(TcpStream::connect(&self.options.host).await?)
    }

    async fn read_frames(&self, incarnation: u64) -> Result<()> {
        self.join(incarnation).await?;
        let socket = self.connect().await?;
        let _present = Present::new(&self.connected);
        let mut read = 0;
        reader::read(socket, incarnation, |more| self.count(&mut read, more)).await
    }

    /// Joins by a connection that is not needed any more then.
    async fn join(&self, incarnation: u64) -> Result<()> {
        let _door = self.doors.acquire().await?;
        let mut client = LearnerClient::connect(format!("http://{}", self.options.host)).await?;
        client.join(JoinRequest { incarnation, protocol: PROTOCOL_VERSION, ..JoinRequest::default() }).await?;
        Ok(())
    }

    /// Counts bytes, and the versions they make.
    fn count(&self, read: &mut u64, more: u64) {
        let whole = |bytes: u64| bytes / self.options.parameters;
        self.versions.fetch_add(whole(*read + more) - whole(*read), Relaxed);
        self.bytes.fetch_add(more, Relaxed);
        *read += more;
    }

    /// One connection, up to the end of this life.
    async fn live(&self, index: usize, identity: &mut Identity, rng: &mut StdRng) -> Result<()> {
        let Options { window, watch, stall_within, churn, kind, .. } = self.options;
        let Identity { actor, incarnation, .. } = *identity;
        let ca = self.options.tls.as_ref().map(|directory| directory.join("ca.pem"));
        let scheme = if ca.is_some() { "https" } else { "http" };
        let endpoint =
            Access { ca, ..Access::default() }.lasting_endpoint(&format!("{scheme}://{}", self.options.host))?;
        let door = self.doors.acquire().await?;
        let mut client = LearnerClient::new(endpoint.connect().await?);
        let reply = match kind {
            Kind::Grpc => {
                let request = JoinRequest { incarnation, actor, protocol: PROTOCOL_VERSION, ..JoinRequest::default() };
                client.join(request).await.context("join")?.into_inner()
            }
            _ => JoinReply::default(),
        };
        let unroll = self.unroll(&reply)?;
        identity.actor = Some(reply.actor);
        let (up, outbound) = mpsc::channel(window.max(1));
        let mut acks = client.send_unrolls(ReceiverStream::new(outbound)).await.context("unrolls")?.into_inner();
        let mut parameters = match watch {
            true => {
                let request = WatchRequest { actor: reply.actor, incarnation };
                Some(client.watch_parameters(request).await.context("parameters")?.into_inner())
            }
            false => None,
        };
        drop(door);
        let _present = Present::new(&self.connected);
        self.lives.fetch_add(1, Relaxed);
        let after = |rng: &mut StdRng| {
            let seconds = churn.map(|mean| -mean * f64::ln(1.0 - rng.random::<f64>()));
            tokio::time::Instant::now() + seconds.map_or(FOREVER, Duration::from_secs_f64)
        };
        let (death, mut stall) = (after(rng), after(rng));
        identity.send_again(&up, &reply, &unroll.0)?;
        // With nothing to watch, an actor acts with what the learner says is the newest.
        if !watch {
            identity.fill(&up, &reply, unroll, window, 0)?;
        }
        let mut acting = None;
        let since = self.now();
        self.wait_from(index, [if window > 0 && !watch { since } else { NEVER }, if watch { since } else { NEVER }]);
        loop {
            tokio::select! {
                ack = acks.message(), if window > 0 => {
                    let ack = ack.context("acknowledgements")?.context("no more acknowledgements")?;
                    self.acked.fetch_add(1, Relaxed);
                    identity.settle(&ack);
                    match ack.verdict() {
                        // Of a duplicate it was the acknowledgement that was lost.
                        Verdict::Taken | Verdict::Duplicate => &self.taken,
                        Verdict::Stale | Verdict::Superseded | Verdict::Rejoin => &self.stale,
                        _ => anyhow::bail!("refused: {}", ack.detail),
                    }
                    .fetch_add(1, Relaxed);
                    // What was sent again is answered before anything is acted with.
                    if acting.is_some() || !watch {
                        self.waited(index, 0);
                        identity.fill(&up, &reply, unroll, window, acting.unwrap_or(ack.version))?;
                    }
                }
                piece = next_piece(&mut parameters), if watch => {
                    let piece = piece.context("parameters")?;
                    if let Some(version) = self.read(&piece) {
                        self.waited(index, 1);
                        if acting.replace(version).is_none() && window > 0 {
                            self.wait_from(index, [self.now(); 2]);
                            identity.fill(&up, &reply, unroll, window, version)?;
                        }
                    }
                    if stall_within.is_some_and(|versions| piece.version > index as u64 % versions) {
                        self.stalled.fetch_add(1, Relaxed);
                        self.wait_from(index, [NEVER; 2]);
                        std::future::pending::<()>().await;
                    }
                }
                () = sleep_until(stall) => {
                    self.stalled.fetch_add(1, Relaxed);
                    self.wait_from(index, [NEVER; 2]);
                    sleep(Duration::from_secs_f64(rng.random_range(STALL))).await;
                    let now = self.now();
                    self.wait_from(index, [if acting.is_some() { now } else { NEVER }, now]);
                    stall = after(rng);
                }
                () = sleep_until(death) => return Ok(()),
            }
        }
    }

    /// Counts a piece, and gives the version that is whole with it.
    fn read(&self, piece: &ParametersChunk) -> Option<u64> {
        let ParametersChunk { version, total, offset, .. } = *piece;
        let bytes = piece.data.len() as u64;
        self.bytes.fetch_add(bytes, Relaxed);
        let newest = self.newest.fetch_max(version, Relaxed).max(version);
        let whole = offset + bytes == total;
        if offset == 0 || whole {
            let mut lags = self.lags.lock().unwrap_or_else(PoisonError::into_inner);
            let place = version as usize;
            if lags.announced.len() <= place {
                lags.announced.resize(place + 1, None);
            }
            let announced = *lags.announced[place].get_or_insert_with(Instant::now);
            if whole {
                lags.versions.push((newest - version) as f64);
                lags.seconds.push(announced.elapsed().as_secs_f64());
            }
        }
        whole.then(|| {
            self.versions.fetch_add(1, Relaxed);
            version
        })
    }
}

async fn next_piece(stream: &mut Option<tonic::Streaming<ParametersChunk>>) -> Result<ParametersChunk, Status> {
    match stream {
        Some(stream) => stream.message().await?.ok_or_else(|| Status::new(Code::Unavailable, "no more parameters")),
        None => std::future::pending().await,
    }
}

/// Counted while it lasts.
struct Present<'a>(&'a AtomicU64);

impl<'a> Present<'a> {
    fn new(count: &'a AtomicU64) -> Self {
        count.fetch_add(1, Relaxed);
        Self(count)
    }
}

impl Drop for Present<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Relaxed);
    }
}

fn quantiles(values: &[f64]) -> Value {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    let at = |share: usize| values.get(values.len().saturating_sub(1) * share / 100).copied();
    json!({ "p50": at(50), "p99": at(99), "max": at(100), "count": values.len() })
}
