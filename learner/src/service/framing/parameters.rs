//! `WatchParameters`: the same frames go to every reader.
//!
//! tonic encodes and copies each message for each stream. For a thousand readers of five megabytes that is most of the
//! processor time and a buffer for each of them; a body of frames that were encoded once is neither.

use std::sync::Arc;

use bytes::Bytes;
use comic_proto::v1::WatchRequest;
use futures::stream;
use http::Response;
use tonic::body::Body;
use tonic::{Status, Streaming};
use tonic_prost::ProstDecoder;

use super::calls::superseded;
use super::roster::Presence;
use super::streams::respond;
use super::{Closing, Shared};
use crate::publish::Subscription;

/// Two numbers.
const REQUEST_LIMIT: usize = 1024;

/// Answers the call.
pub(super) async fn watch(shared: &Arc<Shared>, request: Body) -> Result<Response<Body>, Status> {
    let decoder = ProstDecoder::<WatchRequest>::default();
    let mut requests = Streaming::new_request(decoder, request, None, Some(REQUEST_LIMIT));
    let request = requests.message().await?.ok_or_else(|| Status::invalid_argument("the request is missing"))?;
    if shared.roster.is_superseded(request.incarnation) {
        return Err(superseded());
    }
    let stranger = || Status::failed_precondition("parameters are for actors that have joined: join first");
    let present = shared.roster.watch(request.incarnation).ok_or_else(stranger)?;
    let (parameters, closing) = (shared.publisher.subscribe(), shared.closing());
    let reader = Reader { shared: shared.clone(), parameters, closing, over: false, _present: present };
    Ok(respond(stream::unfold(reader, Reader::next)))
}

struct Reader {
    shared: Arc<Shared>,
    parameters: Subscription,
    closing: Closing,
    over: bool,
    _present: Presence,
}

impl Reader {
    /// The next piece of the newest parameters. At the server's end only a farewell is still sent, or else that it drains.
    async fn next(mut self) -> Option<(Result<Bytes, Status>, Self)> {
        let Self { shared, parameters, closing, over, .. } = &mut self;
        if *over {
            return None;
        }
        let piece = if closing.has_begun() {
            parameters.farewell()
        } else {
            tokio::select! {
                biased;
                () = closing.begun() => parameters.farewell(),
                piece = parameters.next() => piece,
            }
        };
        *over = piece.is_none();
        let answer = piece.map(|piece| Ok(piece.frame)).or_else(|| shared.parting().map(Err))?;
        Some((answer, self))
    }
}
