//! The protocol between actors and learner: messages, the layout of an unroll, and the validation of received data.
//!
//! # Layout
//! - [`v1`] is generated from `comic/v1/learner.proto`: messages, client and server.
//! - [`UnrollLayout`] has the position of each [`Field`] of an unroll in the payload, and a hash that both sides
//!   compare. It follows from an [`UnrollShape`], which follows from the experiment and the task spec.
//! - [`PerField`] is an array with one value for each field.
//! - [`UnrollBuffer`] is an unroll that an actor writes.
//! - [`ReceivedUnroll`] is an unroll that a learner has received, in the [`Pieces`] of the network.
//! - [`frame`](frame()) encodes a message with gRPC's prefix, and a [`FrameReader`] finds messages in received bytes.
//! - [`Access`] is a client's access to a learner: URL, TLS, and [`Token`].
//! - [`validate()`] checks a payload before it is copied into a batch.
//!
//! # An unroll
//! An unroll has `T` transitions and `T + 1` rows of observations. Row `t` has the observation before transition `t`.
//! `Valid[t] = 1`: action, reward and discount of row `t` lead to the observation in row `t + 1`; a step that
//! terminates the episode has discount 0, a step that truncates it discount 1. `Valid[t] = 0`: row `t` is the last
//! observation of an episode and has no action; row `t + 1` is the first observation of the next one, and `First[t + 1]
//! = 1`.

#[cfg(target_endian = "big")]
compile_error!("the payload of an unroll is little-endian and is copied, not converted");

mod access;
mod access_error;
mod buffer;
mod field;
mod frame;
mod layout;
mod per_field;
mod pieces;
mod shape;
mod token;
mod validate;

/// Messages, client and server generated from `comic/v1/learner.proto`.
#[allow(missing_docs, unreachable_pub, clippy::all)]
pub mod v1 {
    tonic::include_proto!("comic.v1");
}

pub use access::{Access, Authorised, Bearer, Client, FRAME_BYTES, chain, distrusted, no_connection, url_of_sibling};
pub use access_error::AccessError;
pub use buffer::UnrollBuffer;
pub use field::Field;
pub use frame::{FrameError, FrameReader, frame};
pub use layout::UnrollLayout;
pub use per_field::PerField;
pub use pieces::{Malformed, Pieces, ReceivedUnroll};
pub use shape::UnrollShape;
pub use token::{TOKEN_VARIABLE, Token};
pub use validate::{Expected, Invalid, MAX_SEQUENCE, validate};

/// The descriptors of the protocol for gRPC reflection.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));

/// Version of the protocol. `Join` compares it. It changes if an older peer would misunderstand a newer one.
pub const PROTOCOL_VERSION: u32 = 5;
