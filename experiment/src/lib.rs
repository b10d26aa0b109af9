//! An experiment is one TOML document. This crate has its types, its defaults and its errors.
//!
//! # Layout
//! - [`Experiment`] is the resolved document. The learner is started with it; actors receive the same document when they
//!   join.
//! - [`presets`] holds the built-in documents: every file `presets/*.toml`.
//! - [`resolve()`] turns a preset or a file plus `--set key=value` overrides into an [`Experiment`]. It refuses unknown
//!   fields and names the nearest known one.
//! - `saved` reads documents of the release before, and knows the format of checkpoints.
//! - [`find_field`] finds a field by the end of its name. [`Experiment::differences`] compares two experiments.
//! - [`for_each_algorithm`] lists the learning algorithms, and [`for_each_task`] the tasks. [`TaskSpec`] is what networks, wire and learner know of a task: sizes and names.
//! - [`seed`] derives independent seeds; [`statistics`] has the median. Every crate uses the same ones.
//!
//! Every default is the paper's: (S) the CoMic supplement, (V) V-MPO. (D) is a decision of this project where both are
//! silent. A preset with other values gives the reason in its file.

mod algorithms;
mod body;
mod check;
mod clips;
mod device;
mod document;
mod error;
mod fault;
mod fields;
mod lines;
mod nearest;
mod network;
pub mod presets;
mod replay;
mod resolve;
mod saved;
pub mod seed;
mod settings;
mod spec;
pub mod statistics;
mod tasks;
mod transfer;
mod vocabulary;

pub use algorithms::{AlgorithmName, Svg0, Vmpo};
pub use body::{ACTION_SIZE, CONTROL_TIMESTEP, IMAGE_SIZE, PROPRIOCEPTION, PROPRIOCEPTION_SIZE};
pub use clips::{ClipSource, SUBSETS};
pub use device::{DeviceName, MatmulPrecision, PublishedNumber};
pub use document::{Complement, Experiment};
pub use error::Error;
pub use fields::{Difference, find_field};
pub use nearest::nearest;
pub use network::{InitialPose, Latent, LowLevelName, Lstm, Mlp, Network, Primitives, Prior};
pub use replay::Replay;
pub use resolve::resolve;
pub use saved::{CHECKPOINT_FORMAT, check_checkpoint_format};
pub use settings::{Actor, Budget, LARGEST_ACTION_GRADIENT, LONGEST_UNROLL, Learner, Optimiser, Unroll};
pub use spec::{TaskPart, TaskSpec};
pub use tasks::*;
pub use transfer::{Transfer, TransferPrior};
