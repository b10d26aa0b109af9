//! Plain HTTP for monitoring: `/metrics` for Prometheus, `/healthz` and `/readyz` for a kubelet. It shows counts and no
//! secret, and accepts no input.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http::header::CONTENT_TYPE;
use http::{Method, Request, Response, StatusCode};
use http_body_util::Full;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;

/// Connections at once; further ones wait to be accepted.
const CONNECTIONS: usize = 64;
/// A connection is one request and its answer, and lasts no longer.
const LIMIT: Duration = Duration::from_secs(10);
/// The pause before the next attempt when the system has no file descriptor left.
const RETRY_DELAY: Duration = Duration::from_millis(100);
const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// What the probes show.
pub trait Probed: Send + Sync + 'static {
    /// The metrics, in the OpenMetrics text format.
    fn metrics_page(&self) -> String;
    /// Whether the learner is going down, so that no actor can join.
    fn is_draining(&self) -> bool;
}

/// Answers until the process ends.
pub async fn serve(listener: TcpListener, probed: Arc<impl Probed>) {
    let places = Arc::new(Semaphore::new(CONNECTIONS));
    // The semaphore is never closed.
    while let Ok(place) = places.clone().acquire_owned().await {
        match listener.accept().await {
            Ok((stream, _)) => {
                let probed = probed.clone();
                tokio::spawn(async move {
                    let _ = tokio::time::timeout(LIMIT, answer(stream, probed)).await;
                    drop(place);
                });
            }
            Err(error) => {
                tracing::warn!(%error, "a connection to the metrics could not be accepted");
                tokio::time::sleep(RETRY_DELAY).await;
            }
        }
    }
}

/// Answers one request. An error means that the peer is gone, or does not speak HTTP.
async fn answer(stream: TcpStream, probed: Arc<impl Probed>) -> Result<(), hyper::Error> {
    let respond = service_fn(move |request: Request<hyper::body::Incoming>| {
        let response = respond(request.method(), request.uri().path(), probed.as_ref());
        async move { Ok::<_, Infallible>(response) }
    });
    let mut http = hyper::server::conn::http1::Builder::new();
    http.timer(TokioTimer::new()).keep_alive(false);
    http.serve_connection(TokioIo::new(stream), respond).await
}

fn respond(method: &Method, path: &str, probed: &impl Probed) -> Response<Full<Bytes>> {
    let (status, kind, body) = match (method, path) {
        (&Method::GET | &Method::HEAD, "/metrics") => (StatusCode::OK, OPEN_METRICS, probed.metrics_page()),
        (&Method::GET | &Method::HEAD, "/healthz") => (StatusCode::OK, "text/plain", "ok\n".into()),
        (&Method::GET | &Method::HEAD, "/readyz") if probed.is_draining() => {
            (StatusCode::SERVICE_UNAVAILABLE, "text/plain", "going down\n".into())
        }
        (&Method::GET | &Method::HEAD, "/readyz") => (StatusCode::OK, "text/plain", "ready\n".into()),
        (_, "/metrics" | "/healthz" | "/readyz") => (StatusCode::METHOD_NOT_ALLOWED, "text/plain", String::new()),
        _ => (StatusCode::NOT_FOUND, "text/plain", "there are /metrics, /healthz and /readyz\n".into()),
    };
    let body = if method == Method::HEAD { Bytes::new() } else { Bytes::from(body) };
    let mut response = Response::new(Full::new(body));
    *response.status_mut() = status;
    response.headers_mut().insert(CONTENT_TYPE, http::HeaderValue::from_static(kind));
    response
}
