//! The messages of a stream of unrolls.
//!
//! A message is read only when there is room for it; until then it stays in the HTTP/2 window of its stream. The unrolls on
//! their way into a batch therefore take at most one window for each connection, [`Room`] for all connections together, and
//! for each stream the frame in which a message ended.

use std::future::poll_fn;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use bytes::Bytes;
use comic_proto::{FrameError, FrameReader, Pieces};
use http_body::{Body as _, Frame};
use http_body_util::BodyExt as _;
use prometheus_client::metrics::counter::Counter;
use tokio::time::{Instant, timeout_at};
use tokio_util::sync::PollSemaphore;
use tonic::Status;
use tonic::body::Body;

use crate::service::room::{Room, Taken};

/// How long a message that has begun may keep room for which others wait.
const TIME_LIMIT: Duration = Duration::from_secs(10);

/// Why no more messages come.
#[derive(Debug)]
pub(super) enum Broken {
    /// The connection, or the call, ended in the middle.
    Connection(Status),
    /// The bytes are not gRPC, or the message is too large.
    Protocol(Status),
}

/// The messages of a request.
#[derive(Debug)]
pub(super) struct Messages {
    body: Body,
    frames: FrameReader,
    /// Bytes of the largest message. The message takes this much room until its length is known.
    limit: u32,
    room: PollSemaphore,
    late: Counter,
    /// The room of the message that is arriving, and the time until which it may keep it.
    taken: Option<(Taken, Instant)>,
}

impl Messages {
    pub(super) fn new(body: Body, limit: usize, room: &Room) -> Self {
        let frames = FrameReader::new(limit);
        let limit = u32::try_from(limit).unwrap_or(u32::MAX);
        Self { body, frames, limit, room: room.free(), late: room.late(), taken: None }
    }

    /// The next message and its room; `None` after the last message. A message that came in the last frame of another one has
    /// no room of its own; such messages are never larger than a frame. Cancel-safe: what has arrived is kept.
    pub(super) async fn next(&mut self) -> Result<Option<(Pieces, Option<Taken>)>, Broken> {
        loop {
            if let Some(message) = self.frames.next_message().map_err(broken)? {
                let taken = self.taken.take().map(|(mut taken, _)| {
                    taken.split(taken.num_permits().saturating_sub(message.len()));
                    taken
                });
                return Ok(Some((message, taken)));
            }
            let frame = match self.frames.has_begun() {
                true => self.read_on().await?,
                false => poll_fn(|context| self.poll_begin(context)).await,
            };
            match frame {
                Some(Ok(frame)) => frame.into_data().into_iter().for_each(|data| self.frames.push(data)),
                Some(Err(error)) => return Err(Broken::Connection(error)),
                None if self.frames.has_begun() => {
                    return Err(Broken::Protocol(Status::internal("the stream ended inside a message")));
                }
                None => return Ok(None),
            }
        }
    }

    /// Asks for the first bytes of a message. The message has room before its bytes are read, and gives the room back while
    /// nothing comes.
    fn poll_begin(&mut self, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        if self.taken.is_none() {
            self.taken = ready!(self.room.poll_acquire_many(context, self.limit))
                .map(|taken| (taken, Instant::now() + TIME_LIMIT));
        }
        let frame = Pin::new(&mut self.body).poll_frame(context);
        if frame.is_pending() {
            self.taken = None;
        }
        frame
    }

    /// Reads more of a message. A message that is not whole after [`TIME_LIMIT`] ends its stream if others wait for its room.
    async fn read_on(&mut self) -> Result<Option<Result<Frame<Bytes>, Status>>, Broken> {
        if self.taken.is_none() {
            let taken = poll_fn(|context| self.room.poll_acquire_many(context, self.limit)).await;
            self.taken = taken.map(|taken| (taken, Instant::now() + TIME_LIMIT));
        }
        // `None` only if the semaphore was closed, which never happens.
        let Some((taken, deadline)) = &mut self.taken else { return Ok(self.body.frame().await) };
        if let Some(length) = self.frames.length() {
            taken.split(taken.num_permits().saturating_sub(length));
        }
        loop {
            match timeout_at(*deadline, self.body.frame()).await {
                Ok(frame) => return Ok(frame),
                Err(_) if self.room.available_permits() >= self.limit as usize => {
                    *deadline = Instant::now() + TIME_LIMIT
                }
                Err(_) => {
                    self.late.inc();
                    let late = format!("others wait for the room of a message that is not whole after {TIME_LIMIT:?}");
                    return Err(Broken::Connection(Status::deadline_exceeded(late)));
                }
            }
        }
    }
}

fn broken(error: FrameError) -> Broken {
    Broken::Protocol(match error {
        FrameError::Compressed => Status::internal(error.to_string()),
        FrameError::Long { .. } => Status::out_of_range(error.to_string()),
    })
}
