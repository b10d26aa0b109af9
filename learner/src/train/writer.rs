//! Checkpoints are written by a separate thread, so that training continues. Only this thread changes the checkpoint
//! directory while the trainer exists.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use crate::checkpoint::{Evaluated, Judgement, Name, Snapshot, Store};
use crate::error::{Error, Result};
use crate::service::TrainerHandle;
use crate::service::offer::Offer;

/// A request to the thread.
#[derive(Debug)]
enum WriteRequest {
    Write(Name, Arc<Snapshot>),
    Judge(Evaluated),
}

/// The writing thread. At most one request waits behind the one being carried out.
#[derive(Debug)]
pub struct Writer {
    queue: SyncSender<WriteRequest>,
    /// Requests that are not yet carried out.
    pending: Arc<AtomicUsize>,
    thread: JoinHandle<Result<()>>,
}

impl Writer {
    /// Starts the thread. Every checkpoint of updates that it has written is offered to evaluators.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(store: Store, service: TrainerHandle) -> Result<Self> {
        let (queue, received) = sync_channel(1);
        let pending = Arc::<AtomicUsize>::default();
        let shared = Arc::clone(&pending);
        let thread = std::thread::Builder::new()
            .name("checkpoints".into())
            .spawn(move || run_writer(store, &received, &shared, &service))
            .map_err(Error::system("cannot start the checkpoint thread"))?;
        Ok(Self { queue, pending, thread })
    }

    /// Whether a request is still being carried out: until then another one may have to wait.
    pub fn is_busy(&self) -> bool {
        self.pending.load(Ordering::Acquire) > 0
    }

    /// Requests that `snapshot` is written; waits while another request waits.
    ///
    /// # Errors
    /// When the thread has ended.
    pub fn write(&self, name: Name, snapshot: Arc<Snapshot>) -> Result<()> {
        self.request(WriteRequest::Write(name, snapshot))
    }

    /// Requests that the evaluated checkpoint is kept if it is the best; waits while another request waits.
    ///
    /// # Errors
    /// When the thread has ended.
    pub fn judge(&self, evaluated: Evaluated) -> Result<()> {
        self.request(WriteRequest::Judge(evaluated))
    }

    fn request(&self, request: WriteRequest) -> Result<()> {
        self.pending.fetch_add(1, Ordering::AcqRel);
        self.queue.send(request).map_err(|_| Error::Panicked("the checkpoint thread"))
    }

    /// Waits until everything is on disk.
    ///
    /// # Errors
    /// When the last snapshot could not be written.
    pub fn finish(self) -> Result<()> {
        drop(self.queue);
        self.thread.join().map_err(|_| Error::Panicked("the checkpoint thread"))?
    }
}

/// Carries out requests until the queue is closed. A write that fails is logged, and training continues, because the next one
/// may succeed. The result is that of the last write.
fn run_writer(
    mut store: Store,
    queue: &Receiver<WriteRequest>,
    pending: &AtomicUsize,
    service: &TrainerHandle,
) -> Result<()> {
    let mut last = Ok(());
    while let Ok(request) = queue.recv() {
        match request {
            WriteRequest::Write(name, snapshot) => {
                store.hold(service.held_checkpoint());
                last = store.write(name, &snapshot).map(|path| {
                    tracing::info!(checkpoint = %path.display(), "written");
                    if matches!(name, Name::Updates(_)) {
                        offer(service, &path, &snapshot);
                    }
                });
                service.prometheus.checkpoints.of(if last.is_ok() { "written" } else { "failed" }).inc();
                if let Err(error) = &last {
                    let error = comic_proto::chain(error);
                    tracing::error!(checkpoint = %name, "checkpoint not written: {error}");
                }
            }
            WriteRequest::Judge(evaluated) => judge(&store, evaluated),
        }
        pending.fetch_sub(1, Ordering::AcqRel);
    }
    last
}

fn offer(service: &TrainerHandle, path: &Path, snapshot: &Snapshot) {
    match Offer::new(path, snapshot) {
        Ok(checkpoint) => service.offer(checkpoint),
        Err(error) => tracing::error!("evaluators do not get this checkpoint: {}", comic_proto::chain(&error)),
    }
}

fn judge(store: &Store, evaluated: Evaluated) {
    let Evaluated { epoch, updates, normalised_reward, .. } = evaluated;
    match store.judge(evaluated) {
        Ok(Judgement::Best(name)) => {
            tracing::info!(checkpoint = %name, normalised_reward, "the best checkpoint so far")
        }
        Ok(Judgement::NotBetter) => {}
        Ok(Judgement::Gone) => {
            tracing::warn!(epoch, updates, normalised_reward, "the evaluated checkpoint does not exist any more");
        }
        Err(error) => {
            let error = comic_proto::chain(&error);
            tracing::error!(normalised_reward, "the best checkpoint is not recorded: {error}");
        }
    }
}
