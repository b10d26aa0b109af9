//! `SendUnrolls`: unrolls in, acknowledgements out.

use std::sync::Arc;

use bytes::Bytes;
use comic_proto::v1::UnrollAck;
use comic_proto::{ReceivedUnroll, frame};
use tonic::Status;
use tonic::body::Body;

use super::messages::{Broken, Messages};
use crate::service::intake::Intake;
use crate::service::room::Room;
use crate::service::shutdown::{Shutdown, Signal};

/// What all streams of unrolls share.
#[derive(Debug)]
pub(in crate::service) struct Unrolls {
    pub(in crate::service) intake: Intake,
    /// Bytes of the largest message.
    pub(in crate::service) message_limit: usize,
    pub(in crate::service) room: Room,
    pub(in crate::service) shutdown: Shutdown,
}

impl Unrolls {
    /// The stream of a request.
    pub(super) fn stream(self: &Arc<Self>, request: Body) -> UnrollStream {
        let messages = Messages::new(request, self.message_limit, &self.room);
        UnrollStream { unrolls: self.clone(), messages, closing: self.shutdown.closing(), over: false }
    }

    /// Reads one unroll and answers it. `None` when the actor sends no more, or the run is over.
    async fn answer(&self, messages: &mut Messages) -> Option<Result<UnrollAck, Status>> {
        // The message keeps its room until its payload is in a batch.
        let (received, _room) = match messages.next().await {
            Ok(Some((message, room))) => {
                let received = ReceivedUnroll::decode(message);
                (received.map_err(|malformed| Status::internal(malformed.to_string())), room)
            }
            Ok(None) => return None,
            // A broken connection is no fault of a message.
            Err(Broken::Connection(status)) => return Some(Err(status)),
            Err(Broken::Protocol(status)) => (Err(status), None),
        };
        match received {
            Ok(unroll) => self.intake.take(unroll).await.transpose(),
            Err(status) => {
                self.intake.refuse_malformed(&status);
                Some(Err(status))
            }
        }
    }
}

/// The stream of one actor. It reads an unroll when the acknowledgement of the unroll before it is sent, and an unroll is
/// acknowledged when it has its place in a batch.
pub(super) struct UnrollStream {
    unrolls: Arc<Unrolls>,
    messages: Messages,
    closing: Signal,
    over: bool,
}

impl UnrollStream {
    /// The next acknowledgement. `None` when the actor sends no more, or the run is over. An actor sends an unroll again that
    /// was not answered before the server closed.
    pub(super) async fn next(mut self) -> Option<(Result<Bytes, Status>, Self)> {
        if self.over {
            return None;
        }
        let answer = tokio::select! {
            biased;
            () = self.closing.given() => self.unrolls.shutdown.status().map(Err),
            // It is safe to drop this at any time: the batcher counts nothing before it takes the unroll.
            answer = self.unrolls.answer(&mut self.messages) => answer,
        }?;
        self.over = answer.is_err();
        Some((answer.map(|ack| frame(&ack)), self))
    }
}
