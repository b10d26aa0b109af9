//! The replay, from which off-policy algorithms learn.

use std::io::{Read, Write};
use std::sync::Arc;
use std::time::Duration;

use comic_experiment::Experiment;
use comic_proto::UnrollLayout;
use comic_replay::{Batch, Batcher, Next, RateLimiter, Sample, Table, TableConfig};
use rand_pcg::Pcg64;
use serde::Serialize;
use tch::Device;

use crate::algorithm::minibatch::MinibatchTensors;
use crate::algorithm::shape::MinibatchShape;
use crate::error::{Error, Result};
use crate::memory_limit::memory_limit;

/// A table of the newest unrolls, from which minibatches are sampled. A rate limiter keeps actors and learner at one pace: actors
/// wait while the learner is behind, and the learner waits for their unrolls.
///
/// Unrolls wait in the batcher until the limiter allows them in. In lockstep a whole batch enters at once, and all samples that
/// are then allowed follow, so nothing depends on the clock.
#[derive(Debug)]
pub struct Replay {
    table: Table,
    config: TableConfig,
    limiter: RateLimiter,
    sample: Sample,
    shape: MinibatchShape,
    device: Device,
    /// Unrolls that enter at once, and the gradient steps that follow, at most; `None` in lockstep, where a batch enters.
    at_once: Option<(usize, usize)>,
    /// The ages of the unrolls sampled since the last report, and their number.
    ages: (u64, u64),
}

/// The state of a replay, in unrolls.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ReplayReport {
    /// In the table.
    pub size: u64,
    /// Inserted, over the whole run if the table is saved.
    pub inserted: u64,
    /// Sampled; an unroll counts each time.
    pub sampled: u64,
    /// Evicted, because the table was full.
    pub evicted: u64,
    /// Mean number of unrolls that were inserted after a sampled one; `None` if nothing was sampled.
    pub sample_age: Option<f64>,
}

/// Bytes of a MiB.
const MIB: u64 = 1 << 20;

impl Replay {
    /// An empty replay that gives minibatches of `minibatch` unrolls. About so many gradient steps follow each insert,
    /// `steps_at_once`.
    ///
    /// # Errors
    /// [`Error::Configuration`] when memory cannot hold it, or its numbers do not go together.
    pub(crate) fn new(
        experiment: &Experiment,
        layout: &Arc<UnrollLayout>,
        tasks: usize,
        minibatch: usize,
        steps_at_once: u64,
        device: Device,
    ) -> Result<Self> {
        let Experiment { replay, unroll, .. } = experiment;
        let length = layout.shape().length.max(1);
        let config = TableConfig {
            max_size: replay.max_size / length,
            sample_size: minibatch,
            memory: allowed_memory(replay.memory_mib)?,
        };
        let refuse = |error: &dyn std::fmt::Display| {
            let named = format!("replay.max_size = {} environment steps", replay.max_size);
            Error::configuration(format!("{named}: {error}; see also replay.memory_mib"))
        };
        let table = Table::new(Arc::clone(layout), config).map_err(|error| refuse(&error))?;
        let (min_size, error_buffer) =
            (replay.min_sequences(length, minibatch) as u64, replay.error_buffer(length, minibatch));
        let limiter = RateLimiter::new(replay.samples_per_insert, min_size, error_buffer, minibatch as u64);
        let limiter = limiter.map_err(|error| Error::configuration(format!("replay: {error}")))?;
        let steps = usize::try_from(steps_at_once).unwrap_or(usize::MAX).max(1);
        let unrolls = (steps as f64 * minibatch as f64 / replay.samples_per_insert) as usize;
        Ok(Self {
            table,
            config,
            limiter,
            sample: Sample::new(Arc::clone(layout), minibatch),
            shape: MinibatchShape { unrolls: minibatch, tasks, unroll: *layout.shape() },
            device,
            at_once: (!unroll.lockstep).then_some((unrolls.max(1), steps)),
            ages: (0, 0),
        })
    }

    /// The next unrolls that may enter, if there are some within this time. The first ones are a whole batch: they give the
    /// normaliser its first scale.
    pub(super) fn next(&self, batcher: &Batcher, patience: Duration) -> Next {
        match self.at_once {
            Some((unrolls, _)) if !self.table.is_empty() => {
                batcher.next_available_within(patience, unrolls.min(self.limiter.insertable()))
            }
            _ => batcher.next_batch_within(patience),
        }
    }

    /// Takes unrolls in. Returns how many minibatches are then sampled: in lockstep all that may be, otherwise at most those of
    /// one publication, but so many that the limiter allows another insert.
    pub(super) fn insert(&mut self, batch: &Batch) -> usize {
        let tasks = batch.tasks();
        self.table.insert(batch.as_unrolls(), &tasks);
        self.limiter.did_insert(tasks.len());
        let (mut ahead, minibatch) = (self.limiter, self.shape.unrolls);
        if self.table.len() < minibatch {
            return 0;
        }
        let most = self.at_once.map_or(usize::MAX, |(_, steps)| steps);
        let mut due = 0;
        while ahead.can_sample(minibatch) && (due < most || ahead.insertable() == 0) {
            ahead.did_sample(minibatch);
            due += 1;
        }
        due
    }

    /// Samples a minibatch.
    ///
    /// # Errors
    /// When the device refuses.
    pub(super) fn sample(&mut self, random: &mut Pcg64) -> Result<MinibatchTensors> {
        if !self.table.sample(&mut self.sample, random) {
            return Err(Error::Defect("the replay holds no minibatch".into()));
        }
        self.limiter.did_sample(self.shape.unrolls);
        let Sample { unrolls, tasks, ages } = &self.sample;
        self.ages = (self.ages.0 + ages.iter().sum::<u64>(), self.ages.1 + ages.len() as u64);
        Ok(MinibatchTensors::new(unrolls, tasks, &self.shape, self.device)?)
    }

    /// Bytes of memory of the table and of a sample.
    pub(crate) fn memory(&self) -> u64 {
        Table::memory(self.sample.unrolls.layout(), self.table.max_size() + self.shape.unrolls)
    }

    /// Its state. The mean age is over the samples since the last report.
    pub(crate) fn report(&mut self) -> ReplayReport {
        let (counts, (ages, sampled)) = (self.table.counts(), std::mem::take(&mut self.ages));
        ReplayReport {
            size: self.table.len() as u64,
            inserted: counts.inserted,
            sampled: counts.sampled,
            evicted: self.table.evicted(),
            sample_age: (sampled > 0).then(|| ages as f64 / sampled as f64),
        }
    }

    /// Writes the table.
    ///
    /// # Errors
    /// When the disk refuses.
    pub(crate) fn write_to(&self, writer: &mut dyn Write) -> std::io::Result<()> {
        self.table.write_to(writer)
    }

    /// Continues with the table that was written.
    ///
    /// # Errors
    /// When it is damaged, or of another experiment.
    pub(crate) fn read_from(&mut self, reader: &mut dyn Read) -> Result<()> {
        // Its memory is free before that of the other table is allocated.
        let layout = Arc::clone(self.sample.unrolls.layout());
        let small = TableConfig { max_size: self.config.sample_size, ..self.config };
        self.table = Table::new(Arc::clone(&layout), small).map_err(|error| damaged(&error))?;
        self.table = Table::read_from(layout, self.config, reader).map_err(|error| damaged(&error))?;
        self.limiter = self.limiter.with_counts(self.table.counts());
        if !self.limiter.is_within() {
            tracing::warn!("samples are counted anew: the replay was saved with other numbers of its rate limiter");
            self.limiter = self.limiter.balanced();
        }
        Ok(())
    }
}

fn damaged(error: &dyn std::fmt::Display) -> Error {
    Error::Checkpoint(format!("the saved replay: {error}"))
}

/// The bytes that a table may use.
///
/// # Errors
/// [`Error::Configuration`] when the process may not use so many.
fn allowed_memory(mebibytes: u64) -> Result<u64> {
    let limit = memory_limit();
    match (mebibytes, limit) {
        (0, limit) => Ok(limit.map_or(u64::MAX, |bytes| bytes / 2)),
        (mebibytes, Some(limit)) if mebibytes > limit / MIB => Err(Error::configuration(format!(
            "replay.memory_mib = {mebibytes}: this process may use {} MiB in all",
            limit / MIB
        ))),
        (mebibytes, _) => Ok(mebibytes.saturating_mul(MIB)),
    }
}
