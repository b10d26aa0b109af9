//! Accepts connections: counts and limits them, and makes the TLS handshake where TLS is on.

use std::collections::HashMap;
use std::future::Future as _;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use futures::stream::{self, Stream};
use parking_lot::Mutex;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio::time::Sleep;
use tonic::transport::server::{Connected, TcpConnectInfo};

use crate::log_limiter::LogLimiter;
use crate::observe::prometheus::Prometheus;
use crate::security::{ConnectionLimits, Tls};

/// The time limit of the TLS handshake, and of the HTTP/2 preface. Each takes a few round trips.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// Bytes with which HTTP/2 begins (RFC 9113, 3.4). After them pings find peers that are gone.
const PREFACE: usize = 24;
/// How long a peer may take to read why its handshake failed.
const ALERT_TIMEOUT: Duration = Duration::from_secs(1);
/// The pause before the next attempt when the system has no file descriptor left.
const RETRY_DELAY: Duration = Duration::from_millis(100);

/// Decides which connections are accepted; a handle that can be cloned.
#[derive(Clone, Debug)]
pub(super) struct Acceptor {
    tls: Option<Arc<Tls>>,
    per_address: usize,
    total: usize,
    open: Arc<Mutex<OpenConnections>>,
    log_limiter: Arc<LogLimiter<IpAddr>>,
    prometheus: Arc<Prometheus>,
}

/// Numbers of open connections.
#[derive(Debug, Default)]
struct OpenConnections {
    by_address: HashMap<IpAddr, usize>,
    total: usize,
}

impl Acceptor {
    pub(super) fn new(tls: Option<Arc<Tls>>, limits: &ConnectionLimits, prometheus: Arc<Prometheus>) -> Self {
        Self {
            tls,
            per_address: limits.max_connections_per_address,
            total: limits.max_connections(),
            open: Arc::default(),
            log_limiter: Arc::default(),
            prometheus,
        }
    }

    /// The accepted connections. Handshakes run concurrently, so that a slow peer does not delay others, and each handshake
    /// counts as a connection.
    pub(super) fn connections(self, listener: TcpListener) -> impl Stream<Item = io::Result<Connection>> {
        stream::unfold((self, listener, JoinSet::new()), |(acceptor, listener, mut handshakes)| async move {
            loop {
                tokio::select! {
                    Some(done) = handshakes.join_next() => {
                        if let Ok(Some(connection)) = done {
                            return Some((Ok(connection), (acceptor, listener, handshakes)));
                        }
                    }
                    accepted = listener.accept() => match accepted {
                        Ok((stream, peer)) => {
                            if let Some(place) = acceptor.reserve(peer) {
                                handshakes.spawn(acceptor.clone().handshake(stream, place));
                            }
                        }
                        Err(error) => {
                            tracing::warn!(%error, "a connection could not be accepted");
                            tokio::time::sleep(RETRY_DELAY).await;
                        }
                    }
                }
            }
        })
    }

    /// A place for a connection of this peer, if the limits allow one.
    fn reserve(&self, peer: SocketAddr) -> Option<Place> {
        let address = peer.ip().to_canonical();
        let mut open = self.open.lock();
        let taken = open.by_address.get(&address).copied().unwrap_or_default();
        let reason = if open.total >= self.total {
            "total"
        } else if taken >= self.per_address {
            "per_address"
        } else {
            open.total += 1;
            open.by_address.insert(address, taken + 1);
            self.prometheus.connections.inc();
            return Some(Place { address, acceptor: self.clone() });
        };
        drop(open);
        self.prometheus.connections_refused.of(reason).inc();
        if let Some(unreported) = self.log_limiter.due(address) {
            let (per_address, total) = (self.per_address, self.total);
            tracing::warn!(%address, unreported, per_address, total, "connection refused: too many");
        }
        None
    }

    /// Makes the TLS handshake where TLS is on. `None` if it fails.
    async fn handshake(self, stream: TcpStream, place: Place) -> Option<Connection> {
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
                self.prometheus.connections_refused.of("tls").inc();
                if let Some(unreported) = self.log_limiter.due(place.address) {
                    tracing::warn!(address = %place.address, unreported, "the TLS handshake failed: {error}");
                }
                if let Some(stream) = stream {
                    let _ = tokio::time::timeout(ALERT_TIMEOUT, close_gently(stream)).await;
                }
                return None;
            }
        };
        Some(Connection::new(stream, info, place))
    }
}

/// Reads what the peer still sends, and then closes. A socket that is closed with unread bytes is reset, and the peer then
/// never reads the alert that says why.
async fn close_gently(mut stream: TcpStream) -> io::Result<()> {
    stream.shutdown().await?;
    let mut rest = [0; 1024];
    while stream.read(&mut rest).await? > 0 {}
    Ok(())
}

/// A connection among those that the limits allow. Its drop frees the place.
#[derive(Debug)]
struct Place {
    address: IpAddr,
    acceptor: Acceptor,
}

impl Drop for Place {
    fn drop(&mut self) {
        self.acceptor.prometheus.connections.dec();
        let mut open = self.acceptor.open.lock();
        open.total -= 1;
        if let Some(connections) = open.by_address.get_mut(&self.address) {
            *connections -= 1;
            if *connections == 0 {
                open.by_address.remove(&self.address);
            }
        }
    }
}

trait Socket: AsyncRead + AsyncWrite + Send {}

impl<T: AsyncRead + AsyncWrite + Send> Socket for T {}

/// An accepted connection, with TLS or without.
pub(super) struct Connection {
    stream: Pin<Box<dyn Socket>>,
    /// Until the peer has sent the HTTP/2 preface: the bytes that are missing, and the time limit.
    preface: Option<(usize, Pin<Box<Sleep>>)>,
    info: TcpConnectInfo,
    _place: Place,
}

impl Connection {
    fn new(stream: Pin<Box<dyn Socket>>, info: TcpConnectInfo, place: Place) -> Self {
        let preface = Some((PREFACE, Box::pin(tokio::time::sleep(HANDSHAKE))));
        Self { stream, preface, info, _place: place }
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
        if let Some((missing, deadline)) = &mut self.preface {
            *missing = missing.saturating_sub(into.filled().len() - before);
            if *missing == 0 {
                self.preface = None;
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
