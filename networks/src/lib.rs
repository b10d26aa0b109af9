//! The networks. Acting and learning use the same functions: acting inside [`acting`], learning with gradient.
//!
//! # Layout
//! - [`Policy`] is what acting needs of every policy; the learner publishes its parameters. [`new_policy`] makes that of an
//!   experiment's algorithm. [`VmpoPolicy`] has a reference encoder and a low level; [`Svg0Policy`] is recurrent.
//! - In joint training each task has its own encoder and value function ([`Routing`]), and all tasks share the low
//!   level.
//! - `low_level` has one file per low level: MLP, LSTM, mixture and product of primitives.
//! - In transfer a new policy gives latents to a [`FrozenLowLevel`], which was learned before. The learner trains only the
//!   new policy. A [`StatePrior`] says which latents are likely in a pose.
//! - If a task has a camera image, the image encoder turns it into a few numbers. They join the task observation, for
//!   policy and value.
//! - [`Value`] is the value function. Only the learner needs it; it has its own parameter store.
//! - [`ActionDistribution`] is the distribution of actions, one Gaussian or a mixture. [`DiagonalGaussian`] is the
//!   distribution of the latent and of each component.
//! - [`to_safetensors`] and [`from_safetensors`] convert a parameter store to bytes and back; [`export`] writes
//!   policies and parts of them as files for other programs.
//!
//! Networks take float32 tensors of rows, `[N, ·]`. In the learner N is unrolls × steps. Recurrent layers take
//! `[B, T, ·]`. The last bits of libtorch's sums depend on N and on the number of threads. Acting has products of its own, so
//! acting and learning give the same numbers up to rounding.
//!
//! By default initial weights are uniform in ±1/√fan_in (variance scaling with scale ⅓), and biases are 0. The random
//! numbers are libtorch's: call `tch::manual_seed` first to make them reproducible.

mod action;
mod algorithms;
mod encoder;
mod error;
pub mod export;
mod frozen;
mod gaussian;
mod high_level;
mod image_encoder;
mod layers;
mod linear;
mod low_level;
mod lstm;
mod normaliser;
mod packed;
mod parameters;
mod policy;
mod prior;
mod resnet;
mod routing;
mod svg0;
mod value;
mod vmpo;
mod weights;

pub use action::ActionDistribution;
pub use algorithms::new_policy;
pub use error::Error;
pub use frozen::FrozenLowLevel;
pub use gaussian::DiagonalGaussian;
pub use linear::acting;
pub use low_level::{Layer, Sizes, low_level_layers};
pub use lstm::RecurrentState;
pub use normaliser::{NORMALISED_LIMIT, NORMALISER_MIN_STD, NormalisedObservation, NormaliserStatistics};
pub use parameters::{from_safetensors, to_bfloat16, to_safetensors};
pub use policy::{Acting, Policy};
pub use prior::StatePrior;
pub use routing::Routing;
pub use svg0::{ActionValue, Core, LatentPolicy, Svg0Policy};
pub use value::Value;
pub use vmpo::VmpoPolicy;
