//! How the learner speaks HTTP/2: windows, frames and pings.

use std::time::Duration;

use comic_proto::UnrollLayout;
use tonic::transport::Server;

/// A peer that does not answer a ping within [`KEEPALIVE_TIMEOUT`] is gone; without pings a half-open connection is never
/// noticed. The documentation promises thirty seconds, also on a busy machine.
const KEEPALIVE: Duration = Duration::from_secs(10);
/// See [`KEEPALIVE`].
const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(10);
/// A call must be answered, or its stream must begin, within this time. A stream that has begun is not limited.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);
/// Bytes of a message besides the payload of an unroll in which one episode ends. A message with a longer header needs a
/// second frame.
const HEADER: usize = 128;
/// Bytes of the largest frame. An unroll of 200 KB in frames of HTTP/2's default 16 KiB costs five times the processor time.
pub(crate) const FRAME_SIZE: u32 = 256 * 1024;
/// Bytes that a connection may have unread in addition to one full stream. Without them a stream that is not read would stop
/// every other call of the same actor.
const BESIDE: u32 = 128 * 1024;
/// RFC 9113, 6.9.2: a peer may send this many bytes before it hears of another window.
const SMALLEST_WINDOW: u32 = 65_535;
/// RFC 9113, 6.9.1.
const LARGEST_WINDOW: u32 = (1 << 31) - 1;
/// Streams that a connection may have open; an actor needs three.
const MAX_STREAMS: u32 = 64;

/// The window of a stream, bytes, unless the operator sets another: the message of one unroll.
///
/// The message then arrives in one frame, or waits at its actor. A message that the end of a window cuts in two must be
/// copied to be joined, keeps the buffers of both halves, and costs twice the processor time.
pub fn window(layout: &UnrollLayout) -> u32 {
    u32::try_from(layout.size().saturating_add(HEADER)).unwrap_or(u32::MAX).clamp(SMALLEST_WINDOW, LARGEST_WINDOW)
}

/// The window of a connection whose streams have this one, bytes.
pub(crate) fn connection_window(window: u32) -> u32 {
    window.saturating_add(BESIDE).min(LARGEST_WINDOW)
}

/// A server that speaks HTTP/2 as the learner does, with this window for each stream, bytes.
pub fn server(window: u32) -> Server {
    Server::builder()
        .http2_keepalive_interval(Some(KEEPALIVE))
        .http2_keepalive_timeout(Some(KEEPALIVE_TIMEOUT))
        .initial_stream_window_size(window)
        .initial_connection_window_size(connection_window(window))
        .max_frame_size(FRAME_SIZE)
        .max_concurrent_streams(MAX_STREAMS)
        .timeout(ANSWER_TIMEOUT)
}
