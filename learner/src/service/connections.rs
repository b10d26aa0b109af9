//! Accepts connections: counts and limits them, and makes the TLS handshake where TLS is on.

use std::future::Future as _;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use futures::stream::{self, Stream};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio::time::{Instant, Sleep};
use tonic::transport::server::Connected;

use super::peer::{self, Peer};
use crate::log_limiter::LogLimiter;
use crate::observe::prometheus::Prometheus;
use crate::places::{Full, Place, Places};
use crate::security::{ConnectionLimits, Tls};

/// How long a connection stays open beyond its age. By then its streams have ended, and their peers have closed it.
const LINGER: Duration = Duration::from_secs(30);
/// How long a peer may take to read why its handshake failed.
const ALERT_TIMEOUT: Duration = Duration::from_secs(1);
/// The pause before the next attempt when the system has no file descriptor left.
const RETRY_DELAY: Duration = Duration::from_millis(100);

/// Decides which connections are accepted; a handle that can be cloned.
#[derive(Clone, Debug)]
pub(super) struct Acceptor {
    tls: Option<Arc<Tls>>,
    limits: ConnectionLimits,
    places: Arc<Places>,
    log_limiter: Arc<LogLimiter<IpAddr>>,
    prometheus: Arc<Prometheus>,
}

impl Acceptor {
    pub(super) fn new(tls: Option<Arc<Tls>>, limits: &ConnectionLimits, prometheus: Arc<Prometheus>) -> Self {
        let places = Places::new(limits.max_connections(), limits.connections_per_address());
        Self { tls, limits: limits.clone(), places, log_limiter: Arc::default(), prometheus }
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
                            if let Some(open) = acceptor.reserve(peer) {
                                handshakes.spawn(acceptor.clone().handshake(stream, peer, open));
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
    fn reserve(&self, peer: SocketAddr) -> Option<OpenConnection> {
        let address = peer.ip();
        let reason = match self.places.take(address) {
            Ok(place) => return Some(OpenConnection::new(place, self.prometheus.clone())),
            Err(Full::Total) => "total",
            Err(Full::Address) => "per_address",
        };
        self.prometheus.connections_refused.of(reason).inc();
        if let Some(unreported) = self.log_limiter.due(address) {
            let (per_address, total) = (self.limits.connections_per_address(), self.limits.max_connections());
            tracing::warn!(%address, unreported, per_address, total, "connection refused: too many");
        }
        None
    }

    /// Makes the TLS handshake where TLS is on. `None` if it fails.
    async fn handshake(self, stream: TcpStream, peer: SocketAddr, open: OpenConnection) -> Option<Connection> {
        let mut peer = Peer::new(peer, &self.limits);
        // A failure costs latency and nothing else.
        let _ = stream.set_nodelay(true);
        let Some(tls) = &self.tls else { return Some(Connection::new(Box::pin(stream), peer, open)) };
        let handshake = tls.acceptor().accept(stream).into_fallible();
        let (error, stream) = match tokio::time::timeout_at(peer.authenticates_until(), handshake).await {
            Ok(Ok(stream)) => {
                let certificate = stream.get_ref().1.peer_certificates().and_then(<[_]>::first);
                peer.owner = certificate.and_then(peer::owner);
                return Some(Connection::new(Box::pin(stream), peer, open));
            }
            Ok(Err((error, stream))) => (error, Some(stream)),
            Err(_) => (io::ErrorKind::TimedOut.into(), None),
        };
        self.prometheus.connections_refused.of("tls").inc();
        let address = peer.address.ip();
        if let Some(unreported) = self.log_limiter.due(address) {
            tracing::warn!(%address, unreported, "the TLS handshake failed: {error}");
        }
        if let Some(stream) = stream {
            let _ = tokio::time::timeout(ALERT_TIMEOUT, close_gently(stream)).await;
        }
        None
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

/// A connection among those that the limits allow, and that are counted. Its drop frees the place.
#[derive(Debug)]
struct OpenConnection {
    prometheus: Arc<Prometheus>,
    _place: Place,
}

impl OpenConnection {
    fn new(place: Place, prometheus: Arc<Prometheus>) -> Self {
        prometheus.connections.inc();
        Self { prometheus, _place: place }
    }
}

impl Drop for OpenConnection {
    fn drop(&mut self) {
        self.prometheus.connections.dec();
    }
}

trait Socket: AsyncRead + AsyncWrite + Send {}

impl<T: AsyncRead + AsyncWrite + Send> Socket for T {}

/// An accepted connection, with TLS or without.
pub(super) struct Connection {
    stream: Pin<Box<dyn Socket>>,
    peer: Peer,
    /// Wakes the connection when it may have to close.
    deadline: Pin<Box<Sleep>>,
    open: OpenConnection,
}

impl Connection {
    fn new(stream: Pin<Box<dyn Socket>>, peer: Peer, open: OpenConnection) -> Self {
        let deadline = Box::pin(tokio::time::sleep_until(peer.authenticates_until()));
        Self { stream, peer, deadline, open }
    }

    /// An error when the peer must have authenticated itself by now, or when the connection is too old. Every operation checks it:
    /// of a peer that reads nothing, HTTP/2 soon reads nothing either.
    fn check_deadline(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        while self.deadline.as_mut().poll(context).is_ready() {
            let closes_at = self.peer.closes_at(LINGER);
            if closes_at <= Instant::now() {
                if !self.peer.is_authenticated() {
                    self.open.prometheus.connections_refused.of("unauthenticated").inc();
                }
                return Err(io::ErrorKind::TimedOut.into());
            }
            self.deadline.as_mut().reset(closes_at);
        }
        Ok(())
    }
}

impl Connected for Connection {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        self.peer.clone()
    }
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, context: &mut Context<'_>, into: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        self.check_deadline(context)?;
        self.stream.as_mut().poll_read(context, into)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.check_deadline(context)?;
        self.stream.as_mut().poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.check_deadline(context)?;
        self.stream.as_mut().poll_write_vectored(context, parts)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check_deadline(context)?;
        self.stream.as_mut().poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream.as_mut().poll_shutdown(context)
    }
}
