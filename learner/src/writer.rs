//! Checkpoints are written by a thread of their own, so that training goes on.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use anyhow::{Context as _, Result, anyhow};

use crate::checkpoint::{Name, Snapshot, Store};
use crate::telemetry::Telemetry;

/// The writing thread. At most one snapshot waits behind the one being written.
#[derive(Debug)]
pub struct Writer {
    queue: SyncSender<(Name, Arc<Snapshot>)>,
    /// Snapshots handed over and not yet written.
    pending: Arc<AtomicUsize>,
    thread: JoinHandle<Result<()>>,
}

impl Writer {
    /// Starts the thread.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(store: Store, telemetry: Arc<Telemetry>) -> Result<Self> {
        let (queue, received) = sync_channel(1);
        let pending = Arc::<AtomicUsize>::default();
        let shared = Arc::clone(&pending);
        let thread = std::thread::Builder::new()
            .name("checkpoints".into())
            .spawn(move || write_all(&store, &received, &shared, &telemetry))
            .context("cannot start the checkpoint thread")?;
        Ok(Self { queue, pending, thread })
    }

    /// Whether a snapshot is still being written.
    pub fn is_busy(&self) -> bool {
        self.pending.load(Ordering::Acquire) > 0
    }

    /// Has `snapshot` written; waits while another one waits.
    ///
    /// # Errors
    /// When the thread is gone.
    pub fn write(&self, name: Name, snapshot: Arc<Snapshot>) -> Result<()> {
        self.pending.fetch_add(1, Ordering::AcqRel);
        self.queue.send((name, snapshot)).map_err(|_| anyhow!("the checkpoint thread is gone"))
    }

    /// Waits until everything is on disk.
    ///
    /// # Errors
    /// When the last snapshot is not.
    pub fn finish(self) -> Result<()> {
        drop(self.queue);
        self.thread.join().map_err(|_| anyhow!("the checkpoint thread failed"))?
    }
}

/// A disk that refuses once may take the next one: training goes on, and the log says so. The last one counts.
fn write_all(
    store: &Store,
    queue: &Receiver<(Name, Arc<Snapshot>)>,
    pending: &AtomicUsize,
    telemetry: &Telemetry,
) -> Result<()> {
    let mut last = Ok(());
    while let Ok((name, snapshot)) = queue.recv() {
        last = store.write(name, &snapshot).map(|path| tracing::info!(checkpoint = %path.display(), "written"));
        telemetry.checkpoints.of(if last.is_ok() { "written" } else { "failed" }).inc();
        if let Err(error) = &last {
            tracing::error!(checkpoint = %name, "checkpoint not written: {error:#}");
        }
        pending.fetch_sub(1, Ordering::AcqRel);
    }
    last
}
