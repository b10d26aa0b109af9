//! The replay, from which SVG(0) learns.

use std::sync::Arc;

use comic_experiment::Experiment;
use comic_proto::UnrollLayout;
use comic_replay::{Batch, RateLimiter, Sample, Table, TableConfig};
use rand_pcg::Pcg64;
use tch::Device;

use crate::algorithm::experience::Experience;
use crate::algorithm::minibatch::MinibatchTensors;
use crate::algorithm::shape::MinibatchShape;
use crate::error::{Error, Result};
use crate::memory_limit::memory_limit;

/// Sequences of the last batches: off-policy. The rate limiter keeps actors and learner at one pace: actors wait while the
/// learner is behind, and the learner waits for their unrolls.
#[derive(Debug)]
pub(super) struct Replay {
    table: Table,
    limiter: RateLimiter,
    sample: Sample,
    shape: MinibatchShape,
    device: Device,
}

/// Bytes of a MiB.
const MIB: u64 = 1 << 20;

impl Replay {
    /// An empty replay.
    ///
    /// # Errors
    /// [`Error::Configuration`] when memory cannot hold it, or its numbers do not go together.
    pub(super) fn new(
        experiment: &Experiment,
        layout: &Arc<UnrollLayout>,
        tasks: usize,
        device: Device,
    ) -> Result<Self> {
        let Experiment { svg0, replay, .. } = experiment;
        let (minibatch, length) = (svg0.minibatch_sequences, layout.shape().length);
        let memory = match replay.memory_mib {
            0 => memory_limit().map_or(u64::MAX, |bytes| bytes / 2),
            mebibytes => mebibytes.saturating_mul(MIB),
        };
        let max_size = replay.max_size / length.max(1);
        let table = Table::new(Arc::clone(layout), TableConfig { max_size, sample_size: minibatch, memory });
        let table = table.map_err(|error| {
            Error::configuration(format!("replay.max_size = {}, replay.memory_mib: {error}", replay.max_size))
        })?;
        let (min_size, error_buffer) =
            (replay.min_sequences(length, minibatch) as u64, replay.error_buffer(length, minibatch));
        let limiter = RateLimiter::new(replay.samples_per_insert, min_size, error_buffer, minibatch as u64);
        Ok(Self {
            table,
            limiter: limiter.map_err(|error| Error::configuration(format!("replay: {error}")))?,
            sample: Sample::new(Arc::clone(layout), minibatch),
            shape: MinibatchShape { unrolls: minibatch, tasks, unroll: *layout.shape() },
            device,
        })
    }

    /// How many minibatches may be sampled before the next insert.
    fn due(&self) -> usize {
        let (mut ahead, minibatch) = (self.limiter, self.shape.unrolls);
        std::iter::from_fn(|| ahead.can_sample(minibatch).then(|| ahead.did_sample(minibatch))).count()
    }
}

impl Experience for Replay {
    fn take(&mut self, batch: &Batch, _: &mut Pcg64) -> Result<usize> {
        let tasks = batch.tasks();
        self.table.insert(batch.as_unrolls(), &tasks);
        self.limiter.did_insert(tasks.len());
        Ok(self.due())
    }

    fn minibatch(&mut self, _: usize, random: &mut Pcg64) -> Result<MinibatchTensors> {
        if !self.table.sample(&mut self.sample, random) {
            return Err(Error::Defect("the replay holds no minibatch".into()));
        }
        self.limiter.did_sample(self.shape.unrolls);
        let Sample { unrolls, tasks, .. } = &self.sample;
        Ok(MinibatchTensors::new(unrolls, tasks, &self.shape, self.device)?)
    }
}
