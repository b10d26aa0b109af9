//! Policies, and parts of policies, as files that describe themselves.
//!
//! # Layout
//! - [`Part`] is the content of a file: the whole policy, the policy of one task, an encoder, or the low level.
//! - [`Spec`] is the description in a file, JSON under the key [`KEY`] of the safetensors metadata: inputs and outputs
//!   in order with their sizes, normalisation, the run, the experiment. `docs/export.md` shows an example.
//! - [`Exported`] writes and reads files. Tensors have the same names as in a checkpoint, so a program that reads a
//!   policy from a checkpoint can read it from a file, and transfer learning can load the low level by name.
//! - [`Exported::open_or_builtin`] also knows the low level that is compiled into the programs. A [`Card`] in a low level's file
//!   says how that was made, and what it does.
//! - [`Exported::save_script`] writes the same policy as TorchScript, and [`Exported::to_onnx`] as ONNX, for programs that do
//!   not know this format.
//!
//! Files may come from anywhere. Networks are built only if the file has the number of weights that its experiment
//! describes. A file is accepted only after every name, shape and number was checked.

mod builtin;
mod card;
mod file;
mod onnx;
mod part;
mod script;
mod spec;
mod weights;

pub use card::{Assessment, Card, ClipEvaluation, Evaluation, Gate, RandomLatents};
pub use file::{Exported, KEY, LONGEST};
pub use part::Part;
pub use spec::{Entry, FORMAT, FittedPrior, Normalisation, Source, Spec, Vector};
