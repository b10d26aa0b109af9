//! Plain HTTP for monitoring: `/metrics` for Prometheus, `/healthz` and `/readyz` for a kubelet. It shows counts and no
//! secret, and accepts no input.

use std::convert::Infallible;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http::header::CONTENT_TYPE;
use http::{Method, Request, Response, StatusCode};
use http_body_util::Full;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;

use crate::places;

/// Connections at once, of all peers and of one address. A further one takes the place of the oldest of the address that has most,
/// so that nobody keeps the places; an answer takes milliseconds.
const CONNECTIONS: usize = 64;
/// See [`CONNECTIONS`].
const CONNECTIONS_PER_ADDRESS: usize = 16;
/// A connection is one request and its answer, and lasts no longer.
const LIMIT: Duration = Duration::from_secs(10);
/// A request has come by then, or the connection is closed.
const REQUEST_LIMIT: Duration = Duration::from_secs(2);
/// A trainer that has not moved for this time is dead. The longest step is the first one on XLA, which compiles for up to eight
/// minutes.
const LONGEST_STEP: Duration = Duration::from_secs(900);
/// The pause before the next attempt when the system has no file descriptor left.
const RETRY_DELAY: Duration = Duration::from_millis(100);
const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// What the probes show.
pub trait Probed: Send + Sync + 'static {
    /// The metrics, in the OpenMetrics text format.
    fn metrics_page(&self) -> String;
    /// Whether the learner is going down, so that no actor can join.
    fn is_draining(&self) -> bool;
    /// The time since the trainer last moved.
    fn silence(&self) -> Duration;
}

/// Answers until the process ends.
pub async fn serve(listener: TcpListener, probed: Arc<impl Probed>) {
    let mut connections = Vec::new();
    loop {
        match listener.accept().await {
            Ok((stream, peer)) => {
                let network = places::network(peer.ip());
                make_room(&mut connections, network);
                let answer = tokio::spawn(tokio::time::timeout(LIMIT, answer(stream, probed.clone())));
                connections.push((network, answer));
            }
            Err(error) => {
                tracing::warn!(%error, "a connection to the metrics could not be accepted");
                tokio::time::sleep(RETRY_DELAY).await;
            }
        }
    }
}

/// Closes the oldest connection of this network, if it has as many as it may, or of the network that has most, if all together
/// have as many as they may.
fn make_room<T>(connections: &mut Vec<(IpAddr, JoinHandle<T>)>, network: IpAddr) {
    connections.retain(|(_, answer)| !answer.is_finished());
    let count = |network: IpAddr| connections.iter().filter(|(other, _)| *other == network).count();
    let crowded = if count(network) >= CONNECTIONS_PER_ADDRESS {
        Some(network)
    } else if connections.len() >= CONNECTIONS {
        connections.iter().map(|(other, _)| *other).max_by_key(|other| count(*other))
    } else {
        None
    };
    if let Some(oldest) = crowded.and_then(|crowded| connections.iter().position(|(other, _)| *other == crowded)) {
        connections.remove(oldest).1.abort();
    }
}

/// Answers one request. An error means that the peer is gone, or does not speak HTTP.
async fn answer(stream: TcpStream, probed: Arc<impl Probed>) -> Result<(), hyper::Error> {
    let respond = service_fn(move |request: Request<hyper::body::Incoming>| {
        let response = respond(request.method(), request.uri().path(), probed.as_ref());
        async move { Ok::<_, Infallible>(response) }
    });
    let mut http = hyper::server::conn::http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(REQUEST_LIMIT).keep_alive(false);
    http.serve_connection(TokioIo::new(stream), respond).await
}

fn respond(method: &Method, path: &str, probed: &impl Probed) -> Response<Full<Bytes>> {
    let (status, kind, body) = match (method, path) {
        (&Method::GET | &Method::HEAD, "/metrics") => (StatusCode::OK, OPEN_METRICS, probed.metrics_page()),
        (&Method::GET | &Method::HEAD, "/healthz") if probed.silence() > LONGEST_STEP => {
            let seconds = probed.silence().as_secs();
            let body = format!("the trainer has not moved for {seconds} s\n");
            (StatusCode::SERVICE_UNAVAILABLE, "text/plain", body)
        }
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

#[cfg(test)]
mod tests {
    use super::*;

    /// A learner whose trainer has not moved for this time.
    struct Silent(Duration);

    impl Probed for Silent {
        fn metrics_page(&self) -> String {
            String::new()
        }
        fn is_draining(&self) -> bool {
            false
        }
        fn silence(&self) -> Duration {
            self.0
        }
    }

    #[tokio::test]
    async fn who_has_most_connections_makes_room() {
        let mut connections = Vec::new();
        let mut connect = |host: [u8; 4]| {
            make_room(&mut connections, host.into());
            connections.push((host.into(), tokio::spawn(std::future::pending::<()>())));
            let count = |host: [u8; 4]| connections.iter().filter(|(other, _)| *other == IpAddr::from(host)).count();
            (connections.len(), count([192, 0, 2, 1]), count([192, 0, 2, 2]))
        };
        assert_eq!(connect([192, 0, 2, 1]), (1, 1, 0), "a kubelet");
        for _ in 0..2 * CONNECTIONS_PER_ADDRESS {
            connect([192, 0, 2, 2]);
        }
        assert_eq!(connect([192, 0, 2, 2]), (1 + CONNECTIONS_PER_ADDRESS, 1, CONNECTIONS_PER_ADDRESS));
        for host in 0..250 {
            connect([198, 51, 100, host % 4]);
        }
        let (all, kubelet, _) = connect([198, 51, 100, 0]);
        assert_eq!((all, kubelet), (CONNECTIONS, 1));
    }

    #[test]
    fn a_learner_whose_trainer_does_not_move_is_not_healthy() {
        let status = |silence| respond(&Method::GET, "/healthz", &Silent(silence)).status();
        assert_eq!(status(LONGEST_STEP), StatusCode::OK);
        assert_eq!(status(LONGEST_STEP + Duration::from_secs(1)), StatusCode::SERVICE_UNAVAILABLE);
    }
}
