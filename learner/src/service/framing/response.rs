//! A gRPC response of frames.

use std::convert::Infallible;

use bytes::Bytes;
use futures::stream::{self, Stream, StreamExt as _};
use http::header::CONTENT_TYPE;
use http::{HeaderMap, HeaderValue, Response};
use http_body::Frame;
use http_body_util::StreamBody;
use tonic::Status;
use tonic::body::Body;

/// A response of these frames. It ends with the first status among them, or with `Ok` after the last frame.
///
/// hyper asks for a frame when it has none left, and then waits for it. Nothing here, and nothing in between, may ask for a
/// frame in advance: a stream of unrolls would then take a place in a batch, and keep it empty.
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

/// The trailers that end a stream with this status.
pub(in crate::service) fn trailers(status: &Status) -> HeaderMap {
    let mut trailers = HeaderMap::new();
    // It cannot fail: the text is percent-encoded, and the learner's statuses have no details.
    let _ = status.add_header(&mut trailers);
    trailers
}
