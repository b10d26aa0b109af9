//! The phase of the training.

/// The phase of the training: which unrolls the trainer uses at this moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Phase {
    /// The learner epoch.
    pub epoch: u64,
    /// The newest published version. Each publication increases it by one.
    pub version: u64,
    /// Unrolls with an older version than this are superseded: they were made in an earlier phase.
    pub oldest: u64,
}

impl Phase {
    /// The first phase of a learner epoch: no version is published yet.
    pub fn begin(epoch: u64) -> Self {
        Self { epoch, version: 0, oldest: 0 }
    }
}
