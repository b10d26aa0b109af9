//! Sends each call to its place.

use std::convert::Infallible;
use std::sync::Arc;
use std::task::{Context, Poll};

use comic_proto::v1::learner_server::LearnerServer;
use futures::future::{BoxFuture, FutureExt as _};
use futures::stream;
use http::{HeaderValue, Request, Response};
use tonic::Status;
use tonic::body::Body;
use tonic::server::NamedService;
use tower::Service;

use super::parameters::Parameters;
use super::response::respond;
use super::unrolls::{UnrollStream, Unrolls};
use crate::service::calls::Calls;

const SEND_UNROLLS: &str = "/comic.v1.Learner/SendUnrolls";
const WATCH_PARAMETERS: &str = "/comic.v1.Learner/WatchParameters";
const ENCODING: &str = "grpc-encoding";
const ACCEPTED: &str = "grpc-accept-encoding";
const IDENTITY: &str = "identity";

/// The learner's gRPC service: the two calls of this folder, and tonic's service for all others.
#[derive(Clone, Debug)]
pub(in crate::service) struct Router {
    calls: LearnerServer<Calls>,
    unrolls: Arc<Unrolls>,
    parameters: Arc<Parameters>,
}

impl Router {
    pub(in crate::service) fn new(
        calls: LearnerServer<Calls>,
        unrolls: Arc<Unrolls>,
        parameters: Arc<Parameters>,
    ) -> Self {
        Self { calls, unrolls, parameters }
    }
}

impl NamedService for Router {
    const NAME: &'static str = <LearnerServer<Calls> as NamedService>::NAME;
}

impl Service<Request<Body>> for Router {
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<'static, Result<Self::Response, Infallible>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Service::<Request<Body>>::poll_ready(&mut self.calls, context)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        match request.uri().path() {
            // gRPC wants an unknown encoding to be told apart from a damaged message.
            SEND_UNROLLS if request.headers().get(ENCODING).is_some_and(|encoding| encoding != IDENTITY) => {
                let mut response = Status::unimplemented("this learner takes no compressed messages").into_http();
                response.headers_mut().insert(ACCEPTED, HeaderValue::from_static(IDENTITY));
                async { Ok(response) }.boxed()
            }
            SEND_UNROLLS => {
                let stream = self.unrolls.stream(request.into_body());
                async move { Ok(respond(stream::unfold(stream, UnrollStream::next))) }.boxed()
            }
            WATCH_PARAMETERS => {
                let parameters = self.parameters.clone();
                let watch = async move { parameters.watch(request.into_body()).await };
                watch.map(|response| Ok(response.unwrap_or_else(Status::into_http))).boxed()
            }
            _ => self.calls.call(request),
        }
    }
}
