//! Checkpoints are written by a thread of their own, so that training goes on.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use anyhow::{Context as _, Result, anyhow};

use crate::checkpoint::{Name, Snapshot, Store};

/// The writing thread. At most one snapshot waits behind the one being written.
#[derive(Debug)]
pub struct Writer {
    queue: SyncSender<(Name, Snapshot)>,
    busy: Arc<AtomicBool>,
    thread: JoinHandle<Result<()>>,
}

impl Writer {
    /// Starts the thread.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(store: Store) -> Result<Self> {
        let (queue, received) = sync_channel(1);
        let busy = Arc::new(AtomicBool::new(false));
        let shared = busy.clone();
        let thread = std::thread::Builder::new()
            .name("checkpoints".into())
            .spawn(move || write_all(&store, &received, &shared))
            .context("cannot start the checkpoint thread")?;
        Ok(Self { queue, busy, thread })
    }

    /// Whether a snapshot is still being written.
    pub fn is_busy(&self) -> bool {
        self.busy.load(Ordering::Acquire)
    }

    /// Has `snapshot` written; waits while another one waits.
    ///
    /// # Errors
    /// When the thread is gone.
    pub fn write(&self, name: Name, snapshot: Snapshot) -> Result<()> {
        self.busy.store(true, Ordering::Release);
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
fn write_all(store: &Store, queue: &Receiver<(Name, Snapshot)>, busy: &AtomicBool) -> Result<()> {
    let mut last = Ok(());
    while let Ok((name, snapshot)) = queue.recv() {
        last = store.write(name, &snapshot).map(|path| tracing::info!(checkpoint = %path.display(), "written"));
        if let Err(error) = &last {
            tracing::error!(checkpoint = %name, "checkpoint not written: {error:#}");
        }
        busy.store(false, Ordering::Release);
    }
    last
}
