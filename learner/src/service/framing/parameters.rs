//! `WatchParameters`: all readers get the same frames.

use std::sync::Arc;

use bytes::Bytes;
use comic_proto::v1::WatchRequest;
use futures::stream;
use http::Response;
use tonic::body::Body;
use tonic::{Status, Streaming};
use tonic_prost::ProstDecoder;

use super::response::respond;
use crate::publish::{Publisher, Subscription};
use crate::service::roster::{Presence, Roster, superseded};
use crate::service::shutdown::{Shutdown, Signal};

/// Bytes of the largest request, which holds two numbers.
const REQUEST_LIMIT: usize = 1024;

/// What all readers of parameters share.
#[derive(Debug)]
pub(in crate::service) struct Parameters {
    pub(in crate::service) publisher: Publisher,
    pub(in crate::service) roster: Arc<Roster>,
    pub(in crate::service) shutdown: Shutdown,
}

impl Parameters {
    /// Answers a request.
    pub(super) async fn watch(&self, request: Body) -> Result<Response<Body>, Status> {
        let decoder = ProstDecoder::<WatchRequest>::default();
        let mut requests = Streaming::new_request(decoder, request, None, Some(REQUEST_LIMIT));
        let request = requests.message().await?.ok_or_else(|| Status::invalid_argument("the request is missing"))?;
        if self.roster.is_superseded(request.incarnation) {
            return Err(superseded());
        }
        let not_joined = || Status::failed_precondition("parameters are for actors that have joined: join first");
        let presence = self.roster.open_stream(request.incarnation).ok_or_else(not_joined)?;
        let reader = Reader {
            parameters: self.publisher.subscribe(),
            shutdown: self.shutdown.clone(),
            closing: self.shutdown.closing(),
            over: false,
            _presence: presence,
        };
        Ok(respond(stream::unfold(reader, Reader::next)))
    }
}

struct Reader {
    parameters: Subscription,
    shutdown: Shutdown,
    closing: Signal,
    over: bool,
    _presence: Presence,
}

impl Reader {
    /// The next piece of the newest parameters. When the server closes, only the end of the run is still sent, or else the
    /// status that the learner drains.
    async fn next(mut self) -> Option<(Result<Bytes, Status>, Self)> {
        let Self { parameters, shutdown, closing, over, .. } = &mut self;
        if *over {
            return None;
        }
        let piece = if closing.is_given() {
            parameters.end_of_run()
        } else {
            tokio::select! {
                biased;
                () = closing.given() => parameters.end_of_run(),
                piece = parameters.next() => piece,
            }
        };
        *over = piece.is_none();
        let answer = piece.map(|piece| Ok(piece.frame)).or_else(|| shutdown.status().map(Err))?;
        Some((answer, self))
    }
}
