//! The networks: what acts and what learns are the same functions, inside `tch::no_grad` or with gradient.
//!
//! # Layout
//! - [`Policy`] is everything acting needs: normaliser, reference encoder, low level. Its parameters travel.
//! - Tasks that are learnt jointly have an encoder and a value function each ([`Routing`]) and share the low level.
//! - The low level is one of several, a file each (`low_level`): MLP, LSTM, mixture and product of primitives.
//! - An image, where the task has one, becomes a few numbers beside the task observation, for policy and value alike.
//! - [`Value`] is what only the learner needs. It lives in a parameter store of its own.
//! - [`ActionDistribution`] is what a policy acts by, one Gaussian or a mixture; [`DiagonalGaussian`] is what it and the
//!   latent are made of.
//! - [`to_safetensors`] and [`from_safetensors`] carry a parameter store over a wire or onto a disk; [`export`] is policies
//!   and parts of them as files that others read.
//!
//! Networks take float32 tensors of rows, `[N, ·]`, where a learner's N is unrolls × steps; what remembers takes
//! `[B, T, ·]`. Sums over N depend in their last bits on N and on the number of threads; with both equal, acting and
//! learning give the same numbers bit for bit, an LSTM's to 1e-5, since the learner joins the products of all steps.
//!
//! Initial weights are uniform in ±1/√fan_in (variance scaling with scale ⅓) and biases 0 unless said otherwise.
//! They come from libtorch's generator: call `tch::manual_seed` first to make them reproducible.

mod action;
mod encoder;
mod error;
pub mod export;
mod gaussian;
mod image_encoder;
mod layers;
mod low_level;
mod lstm;
mod normaliser;
mod parameters;
mod policy;
mod routing;
mod value;

pub use action::ActionDistribution;
pub use error::Error;
pub use gaussian::DiagonalGaussian;
pub use low_level::{Layer, Sizes, low_level_layers};
pub use lstm::RecurrentState;
pub use normaliser::{NORMALISED_LIMIT, NORMALISER_MIN_STD, NormalisedObservation, NormaliserStatistics};
pub use parameters::{from_safetensors, to_safetensors};
pub use policy::{Acting, Policy};
pub use routing::Routing;
pub use value::Value;
