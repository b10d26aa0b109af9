//! Decides whether a call is answered, and whether a stream may go on: it needs a token, a place among the calls in flight, and
//! a connection that is not too old.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::Bytes;
use futures::future::BoxFuture;
use http::header::AUTHORIZATION;
use http::{Request, Response};
use http_body::{Frame, SizeHint};
use prometheus_client::metrics::gauge::Gauge;
use tokio::time::{Instant, Interval, MissedTickBehavior};
use tonic::Status;
use tonic::body::Body;
use tower::{Layer, Service};

use super::framing::response::trailers;
use super::peer::Peer;
use crate::observe::prometheus::Prometheus;
use crate::places::{Full, Place, Places};
use crate::security::{ConnectionLimits, Shown, Tokens};

/// The one call that needs no token, so that the health checks of containers need no secret.
const PUBLIC: &str = "/grpc.health.v1.Health/Check";
/// Public calls in flight. A kubelet makes one at a time.
pub(super) const PUBLIC_CALLS: usize = 64;
/// Public calls in flight from one address.
const PUBLIC_CALLS_PER_ADDRESS: usize = 16;
/// How often a stream asks whether it may go on: a withdrawn token, or the age of its connection, ends it within this time.
const RECHECK: Duration = Duration::from_secs(5);

/// The tower layer that authorises calls, for all connections together.
#[derive(Clone, Debug)]
pub(super) struct AuthorisationLayer {
    tokens: Option<Arc<Tokens>>,
    places: Arc<Places>,
    public_places: Arc<Places>,
    prometheus: Arc<Prometheus>,
}

impl AuthorisationLayer {
    pub(super) fn new(tokens: Option<Arc<Tokens>>, limits: &ConnectionLimits, prometheus: Arc<Prometheus>) -> Self {
        let places = Places::new(limits.max_requests, limits.calls_per_address());
        Self { tokens, places, public_places: Places::new(PUBLIC_CALLS, PUBLIC_CALLS_PER_ADDRESS), prometheus }
    }

    fn authorise<B>(&self, request: &Request<B>) -> Result<Authorised, Status> {
        let Some(peer) = request.extensions().get::<Peer>() else {
            return Err(Status::internal("a defect of the learner: a call without a connection"));
        };
        if request.uri().path() == PUBLIC {
            return self.admit(&self.public_places, peer, None);
        }
        let shown = self.check_token(request.headers().get(AUTHORIZATION).map(http::HeaderValue::as_bytes))?;
        peer.authenticate();
        self.admit(&self.places, peer, shown)
    }

    /// The accepted token, where one is needed.
    fn check_token(&self, header: Option<&[u8]>) -> Result<Option<Shown>, Status> {
        let Some(tokens) = &self.tokens else { return Ok(None) };
        let shown = tokens.accept(header).ok_or_else(|| {
            let what = if header.is_none() { "a token, but none was sent" } else { "another token" };
            self.unauthenticated(what)
        });
        shown.map(Some)
    }

    fn unauthenticated(&self, what: &str) -> Status {
        self.prometheus.requests_refused.of("unauthenticated").inc();
        Status::unauthenticated(format!("this learner requires {what}: see --token-file and COMIC_TOKEN"))
    }

    /// Gives a call its place.
    fn admit(&self, places: &Arc<Places>, peer: &Peer, shown: Option<Shown>) -> Result<Authorised, Status> {
        check_age(peer)?;
        let place = places.take(peer.address.ip()).map_err(|full| {
            self.prometheus.requests_refused.of("overloaded").inc();
            Status::resource_exhausted(match full {
                Full::Total => "too many calls are in flight: try again later",
                Full::Address => "too many calls from this address are in flight: try again later",
            })
        })?;
        self.prometheus.requests.inc();
        let requests = self.prometheus.requests.clone();
        Ok(Authorised { layer: self.clone(), peer: peer.clone(), shown, requests, _place: place })
    }
}

fn check_age(peer: &Peer) -> Result<(), Status> {
    if Instant::now() < peer.expires {
        return Ok(());
    }
    Err(Status::unavailable("this connection has reached the age of --max-connection-age: connect again"))
}

/// A call's place among those in flight, and what it was authorised by.
#[derive(Debug)]
struct Authorised {
    layer: AuthorisationLayer,
    peer: Peer,
    shown: Option<Shown>,
    requests: Gauge,
    _place: Place,
}

impl Authorised {
    /// Whether the call may go on.
    fn check(&self) -> Result<(), Status> {
        check_age(&self.peer)?;
        match (&self.layer.tokens, &self.shown) {
            (Some(tokens), Some(shown)) if !tokens.still_accept(shown) => {
                Err(self.layer.unauthenticated("another token"))
            }
            _ => Ok(()),
        }
    }
}

impl Drop for Authorised {
    fn drop(&mut self) {
        self.requests.dec();
    }
}

impl<S> Layer<S> for AuthorisationLayer {
    type Service = AuthorisationService<S>;

    fn layer(&self, inner: S) -> AuthorisationService<S> {
        AuthorisationService { layer: self.clone(), inner }
    }
}

/// A service behind an [`AuthorisationLayer`].
#[derive(Clone, Debug)]
pub(super) struct AuthorisationService<S> {
    layer: AuthorisationLayer,
    inner: S,
}

impl<S, B> Service<Request<B>> for AuthorisationService<S>
where
    S: Service<Request<B>, Response = Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = BoxFuture<'static, Result<Self::Response, S::Error>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<B>) -> Self::Future {
        match self.layer.authorise(&request) {
            Err(refused) => Box::pin(async move { Ok(refused.into_http()) }),
            Ok(authorised) => {
                let answer = self.inner.call(request);
                Box::pin(async move { Ok(answer.await?.map(|body| Body::new(Held::new(body, authorised)))) })
            }
        }
    }
}

/// The body of an answer. Its call keeps its place among the calls in flight until the body ends. The body of a stream ends
/// early when the call may not go on.
struct Held {
    body: Body,
    authorised: Authorised,
    recheck: Interval,
    ended: bool,
}

impl Held {
    fn new(body: Body, authorised: Authorised) -> Self {
        let mut recheck = tokio::time::interval_at(Instant::now() + RECHECK, RECHECK);
        // Nothing asks while the peer reads nothing.
        recheck.set_missed_tick_behavior(MissedTickBehavior::Delay);
        Self { body, authorised, recheck, ended: false }
    }
}

impl http_body::Body for Held {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        if self.ended {
            return Poll::Ready(None);
        }
        while self.recheck.poll_tick(context).is_ready() {
            if let Err(status) = self.authorised.check() {
                self.ended = true;
                return Poll::Ready(Some(Ok(Frame::trailers(trailers(&status)))));
            }
        }
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.ended || self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
