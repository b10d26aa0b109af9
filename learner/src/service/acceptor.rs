//! Connections as they come in: counted, limited, and through TLS where it is on.

use std::collections::HashMap;
use std::future::Future as _;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use std::time::Duration;

use futures::stream::{self, Stream};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio::time::Sleep;
use tonic::transport::server::{Connected, TcpConnectInfo};

use super::lock;
use crate::log_limiter::LogLimiter;
use crate::observe::telemetry::Telemetry;
use crate::security::{ConnectionLimits, Tls};

/// A handshake takes a few round trips, TLS's and HTTP/2's each; whoever takes longer is turned away.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// Bytes with which HTTP/2 begins (RFC 9113, 3.4). From then on pings find out who is not there any more.
const PREFACE: usize = 24;
/// How long a peer whose handshake failed may take to read why.
const LINGER: Duration = Duration::from_secs(1);
/// Before listening again when the system has no file descriptor to give.
const BREATH: Duration = Duration::from_millis(100);

/// What decides about a connection.
#[derive(Clone, Debug)]
pub(super) struct Acceptor {
    tls: Option<Arc<Tls>>,
    per_address: usize,
    in_all: usize,
    places: Arc<Mutex<Places>>,
    log_limiter: Arc<LogLimiter<IpAddr>>,
    telemetry: Arc<Telemetry>,
}

#[derive(Debug, Default)]
struct Places {
    taken: HashMap<IpAddr, usize>,
    in_all: usize,
}

impl Acceptor {
    pub(super) fn new(tls: Option<Arc<Tls>>, limits: &ConnectionLimits, telemetry: Arc<Telemetry>) -> Self {
        Self {
            tls,
            per_address: limits.max_connections_per_address,
            in_all: limits.max_connections(),
            places: Arc::default(),
            log_limiter: Arc::default(),
            telemetry,
        }
    }

    /// The connections that get in. Handshakes run beside one another, so that a slow peer keeps nobody waiting, and
    /// each takes one of the limited places.
    pub(super) fn open(self, listener: TcpListener) -> impl Stream<Item = io::Result<Connection>> {
        stream::unfold((self, listener, JoinSet::new()), |(door, listener, mut handshakes)| async move {
            loop {
                tokio::select! {
                    Some(done) = handshakes.join_next() => {
                        if let Ok(Some(connection)) = done {
                            return Some((Ok(connection), (door, listener, handshakes)));
                        }
                    }
                    accepted = listener.accept() => match accepted {
                        Ok((stream, peer)) => {
                            if let Some(place) = door.place(peer) {
                                handshakes.spawn(door.clone().receive(stream, place));
                            }
                        }
                        Err(error) => {
                            tracing::warn!(%error, "a connection could not be accepted");
                            tokio::time::sleep(BREATH).await;
                        }
                    }
                }
            }
        })
    }

    fn place(&self, peer: SocketAddr) -> Option<Place> {
        let address = peer.ip().to_canonical();
        let mut places = lock(&self.places);
        let taken = places.taken.get(&address).copied().unwrap_or_default();
        let reason = if places.in_all >= self.in_all {
            "in_all"
        } else if taken >= self.per_address {
            "per_address"
        } else {
            places.in_all += 1;
            places.taken.insert(address, taken + 1);
            self.telemetry.connections.inc();
            return Some(Place { address, door: self.clone() });
        };
        drop(places);
        self.telemetry.connections_refused.of(reason).inc();
        if let Some(unreported) = self.log_limiter.due(address) {
            let (per_address, in_all) = (self.per_address, self.in_all);
            tracing::warn!(%address, unreported, per_address, in_all, "connection refused: too many");
        }
        None
    }

    async fn receive(self, stream: TcpStream, place: Place) -> Option<Connection> {
        let info = stream.connect_info();
        // A failure costs latency and nothing else.
        let _ = stream.set_nodelay(true);
        let stream: Pin<Box<dyn Socket>> = match &self.tls {
            None => Box::pin(stream),
            Some(tls) => {
                let handshake = tls.acceptor().accept(stream).into_fallible();
                let (error, stream) = match tokio::time::timeout(HANDSHAKE, handshake).await {
                    Ok(Ok(stream)) => return Some(Connection::new(Box::pin(stream), info, place)),
                    Ok(Err((error, stream))) => (error, Some(stream)),
                    Err(_) => (io::ErrorKind::TimedOut.into(), None),
                };
                self.telemetry.connections_refused.of("tls").inc();
                if let Some(unreported) = self.log_limiter.due(place.address) {
                    tracing::warn!(address = %place.address, unreported, "no agreement on TLS: {error}");
                }
                if let Some(stream) = stream {
                    let _ = tokio::time::timeout(LINGER, linger(stream)).await;
                }
                return None;
            }
        };
        Some(Connection::new(stream, info, place))
    }
}

/// Closed at once, with bytes of the peer unread, a socket is reset, and the peer never reads the alert that says why.
async fn linger(mut stream: TcpStream) -> io::Result<()> {
    stream.shutdown().await?;
    let mut rest = [0; 1024];
    while stream.read(&mut rest).await? > 0 {}
    Ok(())
}

/// A connection's place among the limited ones.
#[derive(Debug)]
struct Place {
    address: IpAddr,
    door: Acceptor,
}

impl Drop for Place {
    fn drop(&mut self) {
        self.door.telemetry.connections.dec();
        let mut places = lock(&self.door.places);
        places.in_all -= 1;
        if let Some(taken) = places.taken.get_mut(&self.address) {
            *taken -= 1;
            if *taken == 0 {
                places.taken.remove(&self.address);
            }
        }
    }
}

trait Socket: AsyncRead + AsyncWrite + Send {}

impl<T: AsyncRead + AsyncWrite + Send> Socket for T {}

/// A connection that got in, with TLS or without.
pub(super) struct Connection {
    stream: Pin<Box<dyn Socket>>,
    /// Of a peer that has not begun to speak HTTP/2: how many bytes are missing, and until when.
    silence: Option<(usize, Pin<Box<Sleep>>)>,
    info: TcpConnectInfo,
    _place: Place,
}

impl Connection {
    fn new(stream: Pin<Box<dyn Socket>>, info: TcpConnectInfo, place: Place) -> Self {
        let silence = Some((PREFACE, Box::pin(tokio::time::sleep(HANDSHAKE))));
        Self { stream, silence, info, _place: place }
    }
}

impl Connected for Connection {
    type ConnectInfo = TcpConnectInfo;

    fn connect_info(&self) -> TcpConnectInfo {
        self.info.clone()
    }
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, context: &mut Context<'_>, into: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let before = into.filled().len();
        let read = self.stream.as_mut().poll_read(context, into);
        if let Some((missing, deadline)) = &mut self.silence {
            *missing = missing.saturating_sub(into.filled().len() - before);
            if *missing == 0 {
                self.silence = None;
            } else if deadline.as_mut().poll(context).is_ready() {
                return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
            }
        }
        read
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.stream.as_mut().poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.stream.as_mut().poll_write_vectored(context, parts)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream.as_mut().poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream.as_mut().poll_shutdown(context)
    }
}
