//! The replay, from which SVG(0) learns.

use std::sync::Arc;

use comic_experiment::Experiment;
use comic_proto::UnrollLayout;
use comic_replay::{Batch, Sample, Store};
use rand_pcg::Pcg64;
use tch::Device;

use crate::algorithm::experience::Experience;
use crate::algorithm::minibatch::MinibatchTensors;
use crate::algorithm::shape::MinibatchShape;
use crate::error::{Error, Result};
use crate::memory_limit::memory_limit;

/// Sequences of the last batches: off-policy. For each sequence that enters, a fixed number is sampled, so actors and learner
/// keep pace: actors wait while the learner is busy, and the learner waits for a batch.
#[derive(Debug)]
pub(super) struct Replay {
    store: Store,
    sample: Sample,
    shape: MinibatchShape,
    device: Device,
    /// Sequences sampled for each one inserted.
    samples_per_insert: f64,
    /// Sequences that are there before the first gradient step.
    begin_at: usize,
    /// Sequences that may be sampled now.
    owed: f64,
}

/// Bytes of a MiB.
const MIB: u64 = 1 << 20;

impl Replay {
    pub(super) fn new(
        experiment: &Experiment,
        layout: &Arc<UnrollLayout>,
        tasks: usize,
        device: Device,
    ) -> Result<Self> {
        let Experiment { svg0, replay, .. } = experiment;
        let (minibatch, length) = (svg0.minibatch_sequences, layout.shape().length);
        let limit = match replay.memory_mib {
            0 => memory_limit().map_or(u64::MAX, |bytes| bytes / 2),
            mebibytes => mebibytes.saturating_mul(MIB),
        };
        let store = Store::new(Arc::clone(layout), replay.max_size, minibatch, limit);
        let store =
            store.map_err(|error| Error::configuration(format!("replay.max_size, replay.memory_mib: {error}")))?;
        Ok(Self {
            sample: Sample::new(Arc::clone(layout), minibatch),
            shape: MinibatchShape { unrolls: minibatch, tasks, unroll: *layout.shape() },
            device,
            samples_per_insert: replay.samples_per_insert,
            begin_at: replay.min_sequences(length, minibatch).min(store.capacity()),
            owed: 0.0,
            store,
        })
    }
}

impl Experience for Replay {
    fn take(&mut self, batch: &Batch, _: &mut Pcg64) -> Result<usize> {
        self.store.insert(batch);
        if self.store.len() < self.begin_at {
            return Ok(0);
        }
        let minibatch = self.shape.unrolls as f64;
        self.owed += self.samples_per_insert * batch.unrolls as f64;
        let steps = (self.owed / minibatch).floor();
        self.owed -= steps * minibatch;
        Ok(steps as usize)
    }

    fn minibatch(&mut self, _: usize, random: &mut Pcg64) -> Result<MinibatchTensors> {
        if !self.store.sample(&mut self.sample, random) {
            return Err(Error::Defect("the replay holds no minibatch".into()));
        }
        let Sample { unrolls, tasks } = &self.sample;
        Ok(MinibatchTensors::new(unrolls, tasks, &self.shape, self.device)?)
    }
}
