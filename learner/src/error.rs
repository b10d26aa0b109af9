//! What can go wrong, and which of it stays wrong.

/// A configuration that is wrong and stays wrong, however often it is tried: exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Misuse(pub(crate) String);

impl Misuse {
    /// What is wrong, and the remedy.
    pub fn new(message: impl Into<String>) -> Self {
        Self(message.into())
    }
}
