//! Many simulated actors in one process.

use std::path::PathBuf;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use anyhow::{Result, ensure};
use bytes::Bytes;
use clap::{Args, ValueEnum};
use comic_experiment::{Experiment, TaskSpec};
use comic_proto::v1::learner_client::LearnerClient;
use comic_proto::v1::{JoinReply, JoinRequest};
use comic_proto::{Field, PROTOCOL_VERSION, UnrollBuffer, UnrollLayout, UnrollShape};
use rand::rngs::StdRng;
use rand::{Rng as _, SeedableRng as _};
use tokio::io::AsyncReadExt as _;
use tokio::net::TcpStream;
use tokio::sync::Semaphore;
use tokio::time::sleep;

use super::identity::Identity;
use super::paper::{experiment, positive};
use super::process::answer_requests;
use super::reader;
use super::statistics::{NEVER, Present, Statistics};
use connection::Connection;

mod connection;

/// Connections that are being made at the same time.
const CONNECTING: usize = 64;
/// After a failure, and between two incarnations of an actor. Each pause is .5 to 2 of it.
const PAUSE: Duration = Duration::from_secs(2);
/// Failures that are printed; the others are only counted.
const PRINTED_FAILURES: u64 = 10;
/// File descriptors beside those of the connections.
const OTHER_FILES: u64 = 256;

/// Run many simulated actors
#[derive(Clone, Debug, Args)]
pub struct Crowd {
    /// The learner's address and port
    #[arg(long)]
    host: String,
    #[arg(long, value_enum, default_value_t = Kind::Grpc)]
    kind: Kind,
    /// Number of actors
    #[arg(long)]
    actors: usize,
    /// Unrolls that an actor has in flight; the default sends none
    #[arg(long, default_value_t = 0)]
    window: usize,
    /// Read parameters
    #[arg(long)]
    watch: bool,
    /// Stop reading for ever, each actor in one of so many versions
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    stall_within: Option<u64>,
    /// Mean seconds between an actor's restarts, and between its stalls
    #[arg(long, value_parser = positive)]
    churn: Option<f64>,
    /// Connect by TLS with the authority and the token that `comic-learner certs` made in this directory
    #[arg(long)]
    tls: Option<PathBuf>,
    /// Bytes of a version, for the kinds that count bytes only
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    parameters: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// Actors of a learner.
    Grpc,
    /// Streams of unrolls to a server that drops them.
    BareGrpc,
    /// Readers of parameters that drop every byte.
    Readers,
    /// Bytes from a socket.
    Sockets,
}

impl Crowd {
    /// Runs the actors and answers requests on standard input until it ends.
    ///
    /// # Errors
    /// Standard input or output that fails.
    pub fn run(&self) -> Result<()> {
        let actors = Arc::new(Actors::new(self));
        comic_learner::service::process::allow_descriptors(self.actors as u64 + OTHER_FILES);
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
        for index in 0..self.actors {
            runtime.spawn(actors.clone().run(index));
        }
        answer_requests(|request| {
            if request == "reset" {
                actors.statistics.reset();
            }
            actors.statistics.to_json()
        })
    }
}

/// What all actors share.
#[derive(Debug)]
struct Actors {
    options: Crowd,
    /// A valid unroll of the experiment that the first actor received, and the hash of its layout.
    unroll: OnceLock<(Bytes, Vec<u8>)>,
    connecting: Semaphore,
    statistics: Statistics,
}

impl Actors {
    fn new(options: &Crowd) -> Self {
        Self {
            unroll: OnceLock::new(),
            connecting: Semaphore::new(CONNECTING),
            statistics: Statistics::new(options.actors),
            options: options.clone(),
        }
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
            Kind::BareGrpc | Kind::Readers | Kind::Sockets => experiment()?.2,
        };
        let mut unroll = UnrollBuffer::new(&layout);
        for t in 0..layout.shape().length {
            unroll.row_mut(Field::Valid, t).fill(1.0);
            unroll.row_mut(Field::Discount, t).fill(1.0);
        }
        Ok(self.unroll.get_or_init(|| (unroll.into_bytes(), layout.hash().to_vec())))
    }

    /// One actor, which connects again after each failure and each restart.
    async fn run(self: Arc<Self>, index: usize) {
        let mut rng = StdRng::seed_from_u64(index as u64);
        let mut identity = Identity::new(None);
        loop {
            let ended = match self.options.kind {
                Kind::Sockets => self.read_socket().await,
                Kind::Readers => self.read_frames(index as u64).await,
                Kind::Grpc | Kind::BareGrpc => match Connection::open(&self, index, &mut identity).await {
                    Ok(mut connection) => connection.run(&mut identity, &mut rng).await,
                    Err(error) => Err(error),
                },
            };
            self.statistics.wait_from(index, [NEVER; 2]);
            match ended {
                Ok(()) => identity = Identity::new(identity.actor),
                Err(error) if self.statistics.failures.fetch_add(1, Relaxed) < PRINTED_FAILURES => {
                    eprintln!("actor {index} of the crowd: {error:#}");
                }
                Err(_) => {}
            }
            sleep(PAUSE.mul_f64(rng.random_range(0.5..2.0))).await;
        }
    }

    async fn read_socket(&self) -> Result<()> {
        let mut socket = self.connect().await?;
        // The host's greeting. Without it the connection may still wait in the system's queue, or have been lost there.
        socket.read_u8().await?;
        let _present = Present::new(&self.statistics.connected);
        let (mut buffer, mut read) = (vec![0; 64 * 1024], 0);
        loop {
            let more = socket.read(&mut buffer).await?;
            ensure!(more > 0, "the host closed the connection");
            self.statistics.count_bytes(&mut read, more as u64, self.options.parameters);
        }
    }

    async fn connect(&self) -> Result<TcpStream> {
        let _permit = self.connecting.acquire().await?;
        Ok(TcpStream::connect(&self.options.host).await?)
    }

    async fn read_frames(&self, incarnation: u64) -> Result<()> {
        self.join(incarnation).await?;
        let socket = self.connect().await?;
        let _present = Present::new(&self.statistics.connected);
        let mut read = 0;
        let count = |more| self.statistics.count_bytes(&mut read, more, self.options.parameters);
        reader::read(socket, incarnation, count).await
    }

    /// Joins through a connection of its own, which closes at once.
    async fn join(&self, incarnation: u64) -> Result<()> {
        let _permit = self.connecting.acquire().await?;
        let mut client = LearnerClient::connect(format!("http://{}", self.options.host)).await?;
        client.join(JoinRequest { incarnation, protocol: PROTOCOL_VERSION, ..JoinRequest::default() }).await?;
        Ok(())
    }
}
