//! The wire between actors and the learner: messages, the unroll's layout, and the checks on what arrives.
//!
//! # Layout
//! - [`v1`] is generated from `comic/v1/learner.proto`: messages, client and server.
//! - [`UnrollLayout`] says where each [`Field`] of an unroll lies in the payload, and hashes that into what both sides
//!   compare. It follows from an [`UnrollShape`], and that from the experiment and the task's spec alone.
//! - [`PerField`] is an array with one value for each field.
//! - [`UnrollBuffer`] is an unroll that an actor writes.
//! - [`ReceivedUnroll`] is one that a learner receives, in the [`Pieces`] in which it came.
//! - [`Access`] is a client's way to a learner: URL, TLS, and the [`Token`] it shows.
//! - [`validate`] is what a payload has to pass before it touches a batch.
//!
//! # An unroll
//! `T` slots for transitions and `T + 1` rows of observations. Row `t` holds the observation before transition `t`.
//! `Valid[t] = 1`: action, reward and discount of row `t` lead to the observation in row `t + 1`; a step that
//! terminated has discount 0, one that was truncated discount 1. `Valid[t] = 0`: row `t` is the last observation of an
//! episode and has no action; row `t + 1` is the first observation of the next one, and `First[t + 1] = 1`.

#[cfg(target_endian = "big")]
compile_error!("the payload of an unroll is little-endian and is copied, not converted");

mod access;
mod buffer;
mod frame;
mod layout;
mod per_field;
mod pieces;
mod token;
mod validate;

/// Messages, client and server generated from `comic/v1/learner.proto`.
#[allow(missing_docs, unreachable_pub, clippy::all)]
pub mod v1 {
    tonic::include_proto!("comic.v1");
}

pub use access::{Access, AccessError, Authorised, Bearer, Client, FRAME_BYTES, chain, distrusted};
pub use buffer::UnrollBuffer;
pub use frame::frame;
pub use layout::{Field, UnrollLayout, UnrollShape};
pub use per_field::PerField;
pub use pieces::{Malformed, Pieces, ReceivedUnroll};
pub use token::{TOKEN_VARIABLE, Token};
pub use validate::{Expected, Invalid, MAX_SEQUENCE, validate};

/// The protocol's descriptors, as gRPC reflection hands them out.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));

/// Version of the protocol, which `Join` compares; it changes whenever an old peer would misunderstand a new one.
pub const PROTOCOL_VERSION: u32 = 3;
