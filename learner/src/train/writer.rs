//! Checkpoints are written by a thread of their own, so that training goes on. It alone changes the checkpoint directory
//! while the trainer lives.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use anyhow::{Context as _, Result, anyhow};

use crate::checkpoint::{Evaluated, Judgement, Name, Snapshot, Store};
use crate::observe::telemetry::Telemetry;

/// What the thread is asked to do.
#[derive(Debug)]
enum WriteRequest {
    Write(Name, Arc<Snapshot>),
    Judge(Evaluated),
}

/// The writing thread. At most one order waits behind the one being carried out.
#[derive(Debug)]
pub struct Writer {
    queue: SyncSender<WriteRequest>,
    /// Orders given and not yet carried out.
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
            .spawn(move || run_writer(&store, &received, &shared, &telemetry))
            .context("cannot start the checkpoint thread")?;
        Ok(Self { queue, pending, thread })
    }

    /// Whether an order is still being carried out: until then another one may have to wait.
    pub fn is_busy(&self) -> bool {
        self.pending.load(Ordering::Acquire) > 0
    }

    /// Has `snapshot` written; waits while another order waits.
    ///
    /// # Errors
    /// When the thread is gone.
    pub fn write(&self, name: Name, snapshot: Arc<Snapshot>) -> Result<()> {
        self.order(WriteRequest::Write(name, snapshot))
    }

    /// Has the checkpoint that was evaluated kept if it is the best; waits while another order waits.
    ///
    /// # Errors
    /// When the thread is gone.
    pub fn judge(&self, evaluated: Evaluated) -> Result<()> {
        self.order(WriteRequest::Judge(evaluated))
    }

    fn order(&self, order: WriteRequest) -> Result<()> {
        self.pending.fetch_add(1, Ordering::AcqRel);
        self.queue.send(order).map_err(|_| anyhow!("the checkpoint thread is gone"))
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
fn run_writer(
    store: &Store,
    queue: &Receiver<WriteRequest>,
    pending: &AtomicUsize,
    telemetry: &Telemetry,
) -> Result<()> {
    let mut last = Ok(());
    while let Ok(order) = queue.recv() {
        match order {
            WriteRequest::Write(name, snapshot) => {
                last = store.write(name, &snapshot).map(|path| tracing::info!(checkpoint = %path.display(), "written"));
                telemetry.checkpoints.of(if last.is_ok() { "written" } else { "failed" }).inc();
                if let Err(error) = &last {
                    tracing::error!(checkpoint = %name, "checkpoint not written: {error:#}");
                }
            }
            WriteRequest::Judge(evaluated) => judge(store, evaluated),
        }
        pending.fetch_sub(1, Ordering::AcqRel);
    }
    last
}

fn judge(store: &Store, evaluated: Evaluated) {
    let Evaluated { epoch, updates, normalised_reward, .. } = evaluated;
    match store.judge(evaluated) {
        Ok(Judgement::Best(name)) => {
            tracing::info!(checkpoint = %name, normalised_reward, "the best checkpoint so far")
        }
        Ok(Judgement::NotBetter) => {}
        Ok(Judgement::Gone) => {
            tracing::warn!(epoch, updates, normalised_reward, "the checkpoint that was evaluated is not kept any more");
        }
        Err(error) => tracing::error!(normalised_reward, "the best checkpoint is not noted: {error:#}"),
    }
}
