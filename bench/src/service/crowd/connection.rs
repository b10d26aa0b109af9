//! One connection of a simulated actor.

use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use anyhow::{Context as _, Result};
use bytes::Bytes;
use comic_proto::v1::learner_client::LearnerClient;
use comic_proto::v1::{JoinReply, JoinRequest, ParametersChunk, UnrollAck, UnrollMessage, Verdict, WatchRequest};
use comic_proto::{Access, PROTOCOL_VERSION};
use rand::Rng as _;
use rand::rngs::StdRng;
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep, sleep_until};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};

use super::super::identity::Identity;
use super::super::statistics::{Awaited, NEVER, Present};
use super::{Actors, Crowd, Kind};

/// Seconds of a stall under `--churn`.
const STALL: std::ops::Range<f64> = 5.0..60.0;
const FOREVER: Duration = Duration::from_secs(86_400 * 365);

/// An actor that has joined.
pub(super) struct Connection<'a> {
    actors: &'a Actors,
    index: usize,
    reply: JoinReply,
    unroll: &'a (Bytes, Vec<u8>),
    up: mpsc::Sender<UnrollMessage>,
    acks: Streaming<UnrollAck>,
    parameters: Option<Streaming<ParametersChunk>>,
    /// The version whose unrolls are sent; none before the first version was read.
    acting: Option<u64>,
    _present: Present<'a>,
}

impl<'a> Connection<'a> {
    pub(super) async fn open(actors: &'a Actors, index: usize, identity: &mut Identity) -> Result<Self> {
        let Crowd { window, watch, kind, tls, host, .. } = &actors.options;
        let Identity { actor, incarnation, .. } = *identity;
        let file = |name: &str| tls.as_ref().map(|directory| directory.join(name));
        let access = Access { ca: file("ca.pem"), token_file: file("token"), ..Access::default() };
        let scheme = if tls.is_some() { "https" } else { "http" };
        let endpoint = access.lasting_endpoint(&format!("{scheme}://{host}"))?;
        let permit = actors.connecting.acquire().await?;
        let mut client = LearnerClient::with_interceptor(endpoint.connect().await?, access.bearer()?);
        let reply = match kind {
            Kind::Grpc => {
                let request = JoinRequest { incarnation, actor, protocol: PROTOCOL_VERSION, ..JoinRequest::default() };
                client.join(request).await.context("join")?.into_inner()
            }
            Kind::BareGrpc | Kind::Readers | Kind::Sockets => JoinReply::default(),
        };
        let unroll = actors.unroll(&reply)?;
        identity.actor = Some(reply.actor);
        let (up, outbound) = mpsc::channel((*window).max(1));
        let acks = client.send_unrolls(ReceiverStream::new(outbound)).await.context("unrolls")?.into_inner();
        let parameters = match watch {
            true => {
                let request = WatchRequest { actor: reply.actor, incarnation };
                Some(client.watch_parameters(request).await.context("parameters")?.into_inner())
            }
            false => None,
        };
        drop(permit);
        let _present = Present::new(&actors.statistics.connected);
        actors.statistics.connections.fetch_add(1, Relaxed);
        Ok(Self { actors, index, reply, unroll, up, acks, parameters, acting: None, _present })
    }

    /// Sends and reads until the actor restarts.
    pub(super) async fn run(&mut self, identity: &mut Identity, rng: &mut StdRng) -> Result<()> {
        let Crowd { window, watch, churn, .. } = self.actors.options;
        let after = |rng: &mut StdRng| {
            let seconds = churn.map(|mean| -mean * f64::ln(1.0 - rng.random::<f64>()));
            Instant::now() + seconds.map_or(FOREVER, Duration::from_secs_f64)
        };
        let (restart, mut stall) = (after(rng), after(rng));
        identity.send_again(&self.up, &self.reply, &self.unroll.0)?;
        // An actor that watches nothing sends unrolls of the version that the learner names as the newest.
        if !watch {
            identity.fill(&self.up, &self.reply, self.unroll, window, 0)?;
        }
        let since = self.actors.statistics.now();
        self.wait_from([if window > 0 && !watch { since } else { NEVER }, if watch { since } else { NEVER }]);
        loop {
            tokio::select! {
                ack = self.acks.message(), if window > 0 => {
                    self.acknowledged(&ack.context("acknowledgements")?.context("no more acknowledgements")?, identity)?;
                }
                piece = next_piece(&mut self.parameters), if watch => {
                    self.received(&piece.context("parameters")?, identity).await?;
                }
                () = sleep_until(stall) => {
                    self.stall(rng.random_range(STALL)).await;
                    stall = after(rng);
                }
                () = sleep_until(restart) => return Ok(()),
            }
        }
    }

    fn acknowledged(&self, ack: &UnrollAck, identity: &mut Identity) -> Result<()> {
        let (Crowd { window, watch, .. }, statistics) = (&self.actors.options, &self.actors.statistics);
        statistics.acked.fetch_add(1, Relaxed);
        identity.settle(ack);
        match ack.verdict() {
            // A duplicate was taken before; its acknowledgement was lost.
            Verdict::Taken | Verdict::Duplicate => &statistics.taken,
            Verdict::Stale | Verdict::Superseded | Verdict::Rejoin => &statistics.stale,
            _ => anyhow::bail!("refused: {}", ack.detail),
        }
        .fetch_add(1, Relaxed);
        // Before the first version, only unrolls that were sent again are acknowledged.
        if self.acting.is_some() || !watch {
            statistics.arrived(self.index, Awaited::Acknowledgement);
            let version = self.acting.unwrap_or(ack.version);
            identity.fill(&self.up, &self.reply, self.unroll, *window, version)?;
        }
        Ok(())
    }

    async fn received(&mut self, piece: &ParametersChunk, identity: &mut Identity) -> Result<()> {
        let (Crowd { window, stall_within, .. }, statistics) = (&self.actors.options, &self.actors.statistics);
        let ParametersChunk { version, total, offset, .. } = *piece;
        let bytes = piece.data.len() as u64;
        let is_last = offset + bytes == total;
        statistics.count_piece(version, bytes, offset == 0, is_last);
        if is_last {
            statistics.arrived(self.index, Awaited::Version);
            if self.acting.replace(version).is_none() && *window > 0 {
                self.wait_from([statistics.now(); 2]);
                identity.fill(&self.up, &self.reply, self.unroll, *window, version)?;
            }
        }
        if stall_within.is_some_and(|versions| version > self.index as u64 % versions) {
            statistics.stalled.fetch_add(1, Relaxed);
            self.wait_from([NEVER; 2]);
            std::future::pending::<()>().await;
        }
        Ok(())
    }

    /// Neither sends nor reads for `seconds`.
    async fn stall(&self, seconds: f64) {
        let statistics = &self.actors.statistics;
        statistics.stalled.fetch_add(1, Relaxed);
        self.wait_from([NEVER; 2]);
        sleep(Duration::from_secs_f64(seconds)).await;
        let now = statistics.now();
        self.wait_from([if self.acting.is_some() { now } else { NEVER }, now]);
    }

    fn wait_from(&self, since: [u64; 2]) {
        self.actors.statistics.wait_from(self.index, since);
    }
}

async fn next_piece(stream: &mut Option<Streaming<ParametersChunk>>) -> Result<ParametersChunk, Status> {
    match stream {
        Some(stream) => stream.message().await?.ok_or_else(|| Status::new(Code::Unavailable, "no more parameters")),
        None => std::future::pending().await,
    }
}
