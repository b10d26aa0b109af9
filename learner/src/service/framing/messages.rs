//! The messages of a stream of unrolls, and the room that they take.
//!
//! What a peer has sent lies in its window until there is room for it here. Unrolls on their way into a batch can take a
//! window for each connection, [`Room`] for all of them together, and for each stream the frame that a message ended in.

use std::future::poll_fn;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use bytes::{Buf as _, Bytes};
use comic_proto::Pieces;
use http_body::{Body as _, Frame};
use http_body_util::BodyExt as _;
use prometheus_client::metrics::counter::Counter;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, timeout_at};
use tokio_util::sync::PollSemaphore;
use tonic::Status;
use tonic::body::Body;

/// "gRPC over HTTP2", Length-Prefixed-Message: whether it is compressed, and its length in four bytes, big end first.
const PREFIX: usize = 5;
/// How long a message that has begun may hold room that others wait for.
const WHOLE: Duration = Duration::from_secs(10);

/// Room for messages that were read and are not in a batch yet, of all streams together, in bytes.
#[derive(Clone, Debug)]
pub(super) struct Room {
    free: Arc<Semaphore>,
    bytes: usize,
    /// Messages that had to give theirs up.
    late: Counter,
}

impl Room {
    pub(super) fn new(bytes: usize, late: Counter) -> Self {
        let bytes = bytes.min(Semaphore::MAX_PERMITS);
        Self { free: Arc::new(Semaphore::new(bytes)), bytes, late }
    }

    /// Bytes that somebody has.
    pub(super) fn taken(&self) -> u64 {
        self.bytes.saturating_sub(self.free.available_permits()) as u64
    }
}

/// Room that is taken until this is dropped.
pub(super) type Taken = OwnedSemaphorePermit;

/// Why no more messages come.
#[derive(Debug)]
pub(super) enum Broken {
    /// The connection, or the call, ended in the middle.
    Connection(Status),
    /// What came is no gRPC, or too large.
    Protocol(Status),
}

/// The messages of a request.
#[derive(Debug)]
pub(super) struct Messages {
    body: Body,
    arrived: Pieces,
    /// Bytes of the message that is arriving, once its prefix has.
    length: Option<usize>,
    /// Bytes of the largest message; so much room is taken before it is known how many there are.
    limit: u32,
    room: PollSemaphore,
    late: Counter,
    /// What the message that is arriving has, and until when it may arrive.
    taken: Option<(Taken, Instant)>,
}

impl Messages {
    pub(super) fn new(body: Body, limit: usize, room: &Room) -> Self {
        let limit = u32::try_from(limit).unwrap_or(u32::MAX);
        let (room, late) = (PollSemaphore::new(room.free.clone()), room.late.clone());
        Self { body, arrived: Pieces::default(), length: None, limit, room, late, taken: None }
    }

    /// The next message and its room; `None` after the last. One that came in the last frame of another has no room: of
    /// those there is no more than a frame holds. Cancel-safe: what has arrived is kept.
    pub(super) async fn next(&mut self) -> Result<Option<(Pieces, Option<Taken>)>, Broken> {
        loop {
            if let Some(message) = self.whole().map_err(Broken::Protocol)? {
                let taken = self.taken.take().map(|(mut taken, _)| {
                    taken.split(taken.num_permits().saturating_sub(message.len()));
                    taken
                });
                return Ok(Some((message, taken)));
            }
            let frame = match self.has_begun() {
                true => self.rest().await?,
                false => poll_fn(|context| self.poll_begin(context)).await,
            };
            match frame {
                Some(Ok(frame)) => frame.into_data().into_iter().for_each(|data| self.arrived.push(data)),
                Some(Err(error)) => return Err(Broken::Connection(error)),
                None if self.has_begun() => {
                    return Err(Broken::Protocol(Status::internal("the stream ended inside a message")));
                }
                None => return Ok(None),
            }
        }
    }

    fn has_begun(&self) -> bool {
        !self.arrived.is_empty() || self.length.is_some()
    }

    /// Asks for the first bytes of a message. There is room for the message before they are taken, and none is kept from
    /// others as long as nothing comes.
    fn poll_begin(&mut self, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        if self.taken.is_none() {
            self.taken =
                ready!(self.room.poll_acquire_many(context, self.limit)).map(|taken| (taken, Instant::now() + WHOLE));
        }
        let frame = Pin::new(&mut self.body).poll_frame(context);
        if frame.is_pending() {
            self.taken = None;
        }
        frame
    }

    /// More of a message. Whoever lets others wait for room that he does not fill has to begin again.
    async fn rest(&mut self) -> Result<Option<Result<Frame<Bytes>, Status>>, Broken> {
        if self.taken.is_none() {
            let taken = poll_fn(|context| self.room.poll_acquire_many(context, self.limit)).await;
            self.taken = taken.map(|taken| (taken, Instant::now() + WHOLE));
        }
        // None only if nobody could ever have room again.
        let Some((taken, deadline)) = &mut self.taken else { return Ok(self.body.frame().await) };
        if let Some(length) = self.length {
            taken.split(taken.num_permits().saturating_sub(length));
        }
        loop {
            match timeout_at(*deadline, self.body.frame()).await {
                Ok(frame) => return Ok(frame),
                Err(_) if self.room.available_permits() >= self.limit as usize => *deadline = Instant::now() + WHOLE,
                Err(_) => {
                    self.late.inc();
                    let late = format!("others wait for the room of a message that is not whole after {WHOLE:?}");
                    return Err(Broken::Connection(Status::deadline_exceeded(late)));
                }
            }
        }
    }

    fn whole(&mut self) -> Result<Option<Pieces>, Status> {
        let length = match self.length {
            Some(length) => length,
            None => {
                let Some(mut prefix) = self.arrived.split_to(PREFIX) else { return Ok(None) };
                if prefix.get_u8() != 0 {
                    return Err(Status::internal("a compressed message, and no encoding was named"));
                }
                let (length, limit) = (prefix.get_u32() as usize, self.limit as usize);
                if length > limit {
                    return Err(Status::out_of_range(format!("a message of {length} bytes, the limit is {limit}")));
                }
                *self.length.insert(length)
            }
        };
        let message = self.arrived.split_to(length);
        if message.is_some() {
            self.length = None;
        }
        Ok(message)
    }
}
