//! The two calls that carry bytes, beneath tonic's codec; all others are tonic's.
//!
//! A message that tonic decodes was copied into a buffer of its stream before, one that it encodes is copied out of one.
//! What comes in here stays where the socket was read to until it is copied into a batch, and what goes out was encoded
//! once for everybody.

use std::convert::Infallible;
use std::sync::Arc;
use std::task::{Context, Poll};

use bytes::Bytes;
use comic_proto::v1::learner_server::LearnerServer;
use futures::future::{BoxFuture, FutureExt as _};
use futures::stream::{self, Stream, StreamExt as _};
use http::header::CONTENT_TYPE;
use http::{HeaderMap, HeaderValue, Request, Response};
use http_body::Frame;
use http_body_util::StreamBody;
use tonic::Status;
use tonic::body::Body;
use tonic::server::NamedService;
use tower::Service;

use super::calls::Calls;
use super::unrolls::UnrollStream;
use super::{Shared, broadcast};

const SEND_UNROLLS: &str = "/comic.v1.Learner/SendUnrolls";
const WATCH_PARAMETERS: &str = "/comic.v1.Learner/WatchParameters";
const ENCODING: &str = "grpc-encoding";
const ACCEPTED: &str = "grpc-accept-encoding";
const IDENTITY: &str = "identity";

/// The learner's calls, those two among them.
#[derive(Clone, Debug)]
pub(super) struct Streams {
    calls: LearnerServer<Calls>,
    shared: Arc<Shared>,
}

impl Streams {
    pub(super) fn new(calls: LearnerServer<Calls>, shared: Arc<Shared>) -> Self {
        Self { calls, shared }
    }
}

impl NamedService for Streams {
    const NAME: &'static str = <LearnerServer<Calls> as NamedService>::NAME;
}

impl Service<Request<Body>> for Streams {
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<'static, Result<Self::Response, Infallible>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Service::<Request<Body>>::poll_ready(&mut self.calls, context)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        let shared = self.shared.clone();
        match request.uri().path() {
            // As gRPC has it: a coding that is not known is told from a broken message.
            SEND_UNROLLS if request.headers().get(ENCODING).is_some_and(|encoding| encoding != IDENTITY) => {
                let mut response = Status::unimplemented("this learner takes no compressed messages").into_http();
                response.headers_mut().insert(ACCEPTED, HeaderValue::from_static(IDENTITY));
                async { Ok(response) }.boxed()
            }
            SEND_UNROLLS => {
                let unrolls = UnrollStream::new(shared, request.into_body());
                async move { Ok(respond(stream::unfold(unrolls, UnrollStream::next))) }.boxed()
            }
            WATCH_PARAMETERS => {
                let watch = async move { broadcast::watch(&shared, request.into_body()).await };
                watch.map(|response| Ok(response.unwrap_or_else(Status::into_http))).boxed()
            }
            _ => self.calls.call(request),
        }
    }
}

/// A response of these frames, which ends with the status that comes instead of one, or else well.
///
/// hyper asks for a frame when it has none in hand, and goes on asking until it comes. Nothing here, and nothing in between,
/// may ask for one ahead: a stream of unrolls waits for a place in a batch then, and who does not ask on keeps it empty.
pub(super) fn respond(frames: impl Stream<Item = Result<Bytes, Status>> + Send + 'static) -> Response<Body> {
    let body = stream::unfold(Some(Box::pin(frames)), async |frames| {
        let mut frames = frames?;
        Some(match frames.next().await {
            Some(Ok(frame)) => (Ok::<_, Infallible>(Frame::data(frame)), Some(frames)),
            Some(Err(status)) => (Ok(Frame::trailers(trailers(&status))), None),
            None => (Ok(Frame::trailers(trailers(&Status::ok("")))), None),
        })
    });
    let mut response = Response::new(Body::new(StreamBody::new(body)));
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static("application/grpc"));
    response
}

fn trailers(status: &Status) -> HeaderMap {
    let mut trailers = HeaderMap::new();
    // Its text is percent-encoded, and no status of ours has details: there is nothing a header could not hold.
    let _ = status.add_header(&mut trailers);
    trailers
}
