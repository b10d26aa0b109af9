//! The phase of the training.

use comic_proto::v1::Behaviour;

/// What the trainer wants at this moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Phase {
    /// The learner's epoch.
    pub epoch: u64,
    /// The newest published version; versions count publications.
    pub version: u64,
    /// Unrolls of versions before this one are superseded: they were made under other conditions.
    pub oldest: u64,
    /// Unrolls of the other behaviour are superseded.
    pub behaviour: Behaviour,
}

impl Phase {
    /// The phase in which an epoch of the learner begins: nothing is published yet, and the policy acts.
    pub fn begin(epoch: u64) -> Self {
        Self { epoch, version: 0, oldest: 0, behaviour: Behaviour::Policy }
    }
}
