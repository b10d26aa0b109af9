//! `WatchParameters`, beneath tonic's codec: the same frames go to every reader.
//!
//! tonic encodes and copies each message for each stream. For a thousand readers of five megabytes that is most of the
//! processor time and a buffer for each of them; a body of frames that were encoded once is neither.

use std::convert::Infallible;
use std::sync::Arc;
use std::task::{Context, Poll};

use bytes::Bytes;
use comic_proto::v1::WatchRequest;
use comic_proto::v1::learner_server::LearnerServer;
use futures::future::{BoxFuture, FutureExt as _};
use futures::stream;
use http::header::CONTENT_TYPE;
use http::{HeaderMap, HeaderName, HeaderValue, Request, Response};
use http_body::Frame;
use http_body_util::StreamBody;
use tonic::body::Body;
use tonic::server::NamedService;
use tonic::{Status, Streaming};
use tonic_prost::ProstDecoder;
use tower::Service;

use super::calls::Calls;
use super::roster::Presence;
use super::{Closing, Shared};
use crate::publish::Subscription;

const WATCH_PARAMETERS: &str = "/comic.v1.Learner/WatchParameters";
/// Two numbers.
const REQUEST_LIMIT: usize = 1024;

/// The learner's calls, and the broadcast among them.
#[derive(Clone, Debug)]
pub(super) struct Broadcast {
    calls: LearnerServer<Calls>,
    shared: Arc<Shared>,
}

impl Broadcast {
    pub(super) fn new(calls: LearnerServer<Calls>, shared: Arc<Shared>) -> Self {
        Self { calls, shared }
    }
}

impl NamedService for Broadcast {
    const NAME: &'static str = <LearnerServer<Calls> as NamedService>::NAME;
}

impl Service<Request<Body>> for Broadcast {
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<'static, Result<Self::Response, Infallible>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Service::<Request<Body>>::poll_ready(&mut self.calls, context)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        if request.uri().path() != WATCH_PARAMETERS {
            return self.calls.call(request);
        }
        let shared = self.shared.clone();
        async move { Ok(watch(&shared, request.into_body()).await.unwrap_or_else(Status::into_http)) }.boxed()
    }
}

async fn watch(shared: &Arc<Shared>, request: Body) -> Result<Response<Body>, Status> {
    let decoder = ProstDecoder::<WatchRequest>::default();
    let mut requests = Streaming::new_request(decoder, request, None, Some(REQUEST_LIMIT));
    let request = requests.message().await?.ok_or_else(|| Status::invalid_argument("the request is missing"))?;
    let present = shared.roster.watch(request.incarnation);
    let reader = Reader { parameters: shared.publisher.subscribe(), closing: shared.closing(), _present: present };
    let mut response = Response::new(Body::new(StreamBody::new(stream::unfold(Some(reader), Reader::next))));
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static("application/grpc"));
    Ok(response)
}

struct Reader {
    parameters: Subscription,
    closing: Closing,
    _present: Presence,
}

impl Reader {
    /// The next piece of the newest parameters, and after the last one the status. At the server's end only a farewell
    /// is still sent.
    async fn next(reader: Option<Self>) -> Option<(Result<Frame<Bytes>, Infallible>, Option<Self>)> {
        let mut reader = reader?;
        let Self { parameters, closing, .. } = &mut reader;
        let piece = if closing.has_begun() {
            parameters.farewell()
        } else {
            tokio::select! {
                biased;
                () = closing.begun() => parameters.farewell(),
                piece = parameters.next() => piece,
            }
        };
        Some(match piece {
            Some(piece) => (Ok(Frame::data(piece.frame)), Some(reader)),
            None => (Ok(Frame::trailers(done())), None),
        })
    }
}

fn done() -> HeaderMap {
    HeaderMap::from_iter([(HeaderName::from_static("grpc-status"), HeaderValue::from_static("0"))])
}
