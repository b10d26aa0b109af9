//! The variables of a store, by name.

use tch::{Tensor, nn};

/// The parameters of `store`, trained or not, as `prefix.name`, sorted by name.
pub(crate) fn named(prefix: &str, store: &nn::VarStore) -> Vec<(String, Tensor)> {
    let mut variables: Vec<(String, Tensor)> =
        store.variables().into_iter().map(|(name, tensor)| (format!("{prefix}.{name}"), tensor)).collect();
    variables.sort_by(|a, b| a.0.cmp(&b.0));
    variables
}

/// The trained parameters among [`named`].
pub(crate) fn trainable(prefix: &str, store: &nn::VarStore) -> Vec<(String, Tensor)> {
    named(prefix, store).into_iter().filter(|(_, tensor)| tensor.requires_grad()).collect()
}
