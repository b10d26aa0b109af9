//! A policy, or a part of one, as a file that says what it is.
//!
//! # Layout
//! - [`Part`] is what a file holds: everything that acts, one task's share of it, an encoder, or the low level.
//! - [`Spec`] is what it says of itself, as JSON under the key [`KEY`] of the safetensors metadata: inputs and outputs in
//!   order with sizes, normalisation, the run it comes from, the experiment. `docs/export.md` shows one.
//! - [`Exported`] is a file, written and read. Tensors keep the names they have in a checkpoint, so what reads a whole
//!   policy reads a file of one, and a network that is made for transfer takes the low level by name.
//! - [`Exported::save_script`] writes the same policy as TorchScript, for programs that know none of this.
//!
//! Files may come from anywhere: nothing is built before the file is known to hold as many numbers as its experiment
//! wants, and nothing is given out before every name, shape and number was looked at.

mod file;
mod part;
mod script;
mod spec;
mod weights;

pub use file::{Exported, KEY, LONGEST};
pub use part::Part;
pub use spec::{Entry, FORMAT, Normalisation, Source, Spec, Vector};
