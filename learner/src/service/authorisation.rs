//! Decides whether a call is answered: it needs a token, and a place among the calls in flight.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use bytes::Bytes;
use futures::future::BoxFuture;
use http::header::AUTHORIZATION;
use http::{Request, Response};
use http_body::{Frame, SizeHint};
use prometheus_client::metrics::gauge::Gauge;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tonic::Status;
use tonic::body::Body;
use tower::{Layer, Service};

use crate::observe::prometheus::Prometheus;
use crate::security::Tokens;

/// The one call that needs no token, so that the health checks of containers need no secret.
const PUBLIC: &str = "/grpc.health.v1.Health/Check";

/// The tower layer that authorises calls, for all connections together.
#[derive(Clone, Debug)]
pub(super) struct AuthorisationLayer {
    tokens: Option<Arc<Tokens>>,
    places: Arc<Semaphore>,
    prometheus: Arc<Prometheus>,
}

impl AuthorisationLayer {
    pub(super) fn new(tokens: Option<Arc<Tokens>>, max_requests: usize, prometheus: Arc<Prometheus>) -> Self {
        let places = Arc::new(Semaphore::new(max_requests.min(Semaphore::MAX_PERMITS)));
        Self { tokens, places, prometheus }
    }

    fn authorise<B>(&self, request: &Request<B>) -> Result<Authorised, Status> {
        let shown = request.headers().get(AUTHORIZATION).map(http::HeaderValue::as_bytes);
        let public = request.uri().path() == PUBLIC;
        if !public && self.tokens.as_ref().is_some_and(|tokens| !tokens.accept(shown)) {
            self.prometheus.requests_refused.of("unauthenticated").inc();
            let what = if shown.is_none() { "a token, but none was sent" } else { "another token" };
            return Err(Status::unauthenticated(format!(
                "this learner requires {what}: see --token-file and COMIC_TOKEN"
            )));
        }
        let Ok(place) = self.places.clone().try_acquire_owned() else {
            self.prometheus.requests_refused.of("overloaded").inc();
            return Err(Status::resource_exhausted("too many calls are in flight: try again later"));
        };
        self.prometheus.requests.inc();
        Ok(Authorised { requests: self.prometheus.requests.clone(), _place: place })
    }
}

/// A call's place among those in flight.
#[derive(Debug)]
struct Authorised {
    requests: Gauge,
    _place: OwnedSemaphorePermit,
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
                Box::pin(async move { Ok(answer.await?.map(|body| Body::new(Held { body, _authorised: authorised }))) })
            }
        }
    }
}

/// The body of an answer. Its call keeps its place among the calls in flight until the body ends.
struct Held {
    body: Body,
    _authorised: Authorised,
}

impl http_body::Body for Held {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
