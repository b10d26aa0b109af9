//! When checkpoints are written, and the newest one in memory.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use comic_experiment::Learner;

use crate::checkpoint::{Evaluated, Name, Snapshot, Store};
use crate::error::Result;
use crate::service::TrainerHandle;
use crate::train::writer::Writer;

/// The checkpoints of a run that trains.
#[derive(Debug)]
pub(super) struct Checkpoints {
    /// The thread that writes; only rank 0 writes.
    writer: Option<Writer>,
    /// Seconds between two of them.
    interval: f64,
    written: Instant,
    /// The last good state: the one to restore when gradient steps are skipped again and again.
    good: Arc<Snapshot>,
}

impl Checkpoints {
    /// Opens the checkpoint directory of `run`, if this rank writes any, and starts the thread that writes.
    ///
    /// # Errors
    /// When the directory cannot be made, or the system gives no thread.
    pub(super) fn start(run: Option<&Path>, learner: &Learner, service: TrainerHandle) -> Result<Self> {
        let start = |run| Writer::start(Store::open(run, learner.checkpoints_kept)?, service);
        let writer = run.map(start).transpose()?;
        Ok(Self { writer, interval: learner.checkpoint_seconds, written: Instant::now(), good: Arc::default() })
    }

    /// Whether the newest checkpoint is old enough for another one, and is on disk: training does not wait for one.
    pub(super) fn are_due(&self) -> bool {
        self.writer.is_some() && self.written.elapsed().as_secs_f64() >= self.interval && !self.is_busy()
    }

    /// Whether the thread still writes: until it has finished, another request may have to wait.
    pub(super) fn is_busy(&self) -> bool {
        self.writer.as_ref().is_some_and(Writer::is_busy)
    }

    /// Keeps a state in memory as the last good one.
    pub(super) fn set_good(&mut self, snapshot: Snapshot) {
        self.good = Arc::new(snapshot);
    }

    /// The last good state.
    pub(super) fn good(&self) -> &Snapshot {
        &self.good
    }

    /// Keeps a state in memory as the last good one, and has it written.
    ///
    /// # Errors
    /// When the writing thread has ended.
    pub(super) fn write(&mut self, name: Name, snapshot: Snapshot) -> Result<()> {
        self.set_good(snapshot);
        self.written = Instant::now();
        self.writer.as_mut().map_or(Ok(()), |writer| writer.write(name, Arc::clone(&self.good)))
    }

    /// Keeps the checkpoint that was evaluated if it is the best.
    ///
    /// # Errors
    /// When the writing thread has ended.
    pub(super) fn judge(&self, evaluated: Evaluated) -> Result<()> {
        self.writer.as_ref().map_or(Ok(()), |writer| writer.judge(evaluated))
    }

    /// Waits until everything is on disk.
    ///
    /// # Errors
    /// When the last snapshot could not be written.
    pub(super) fn finish(self) -> Result<()> {
        self.writer.map_or(Ok(()), Writer::finish)
    }
}
