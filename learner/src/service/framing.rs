//! The two calls that carry bytes, without tonic's codec.
//!
//! # Why it exists
//! `SendUnrolls` and `WatchParameters` carry nearly all bytes of a run. tonic's codec copies each of these bytes at least
//! once more than is necessary:
//! - On the way in, tonic copies each HTTP/2 frame into a buffer of its stream before it decodes the message, and the message
//!   is then copied into the batch. With 1000 actors these copies, and the memory pages that they needed, took half of the
//!   service's processor time.
//! - On the way out, tonic encodes and copies each message for each stream. For 1000 readers of a version of 5 MB that was
//!   most of the processor time, and one buffer for each reader.
//!
//! # What it does instead
//! - [`router`] sends the two calls here and leaves all others to tonic.
//! - [`messages`] finds the messages in the frames of a stream without joining the frames (`comic_proto::Pieces`). An unroll
//!   stays where the socket was read to until it is copied into its place in a batch: one copy. It also takes
//!   [room](super::room) for a message before the message is read.
//! - [`unrolls`] answers one stream of unrolls; what is done with an unroll is in [`intake`](super::intake).
//! - [`parameters`] sends each reader the frames that [`publish`](crate::publish) encoded once for all of them.
//! - [`response`] makes a gRPC response of frames.
//!
//! Everything below the codec is the library's: hyper speaks HTTP/2, and prost decodes the messages.
//!
//! # What it bought
//! Measured by `cargo xtask bench ingest` and `publish` on two x86-64 cores, which the service shares with the actors. An
//! unroll has 208 KB and a version 5 MB; docs/benchmarks.md has all figures and their conditions.
//!
//! | figure | value | compared with |
//! | --- | --- | --- |
//! | `ingest.32` | 3,352 MB/s into batches | 0.98 of a bare tonic stream that drops what it reads |
//! | `ingest.1000` | 2,201 MB/s into batches, 127 MB of memory | 0.89 of that stream, which takes 540 MB |
//! | `publish.1000` | 5,098 MB/s, 6 MB of memory | 0.95 of bare sockets |
//!
//! # Rules
//! - Nothing here reads a frame before the frame before it is dealt with, so that HTTP/2's flow control carries the back
//!   pressure of the batches to the actors.
//! - The bytes come from the network: every length is checked before memory is taken for it. `learner/tests/service/frames.rs`
//!   and `room.rs` hold this.

mod messages;
pub(super) mod parameters;
pub(super) mod response;
pub(super) mod router;
pub(super) mod unrolls;
