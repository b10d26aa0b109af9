//! Sends parameters to the actors: the newest version, encoded once, with one copy in memory for all readers.
//!
//! A reader finishes the version that it began, even if newer versions are published meanwhile; a slow reader that started
//! again with each of them would never finish one. But a reader that stalls must not keep its version in memory. Therefore a
//! few versions are *held* for their readers, and the readers themselves hold nothing. When a newer version needs a place, it
//! replaces a held version that is not read any more or that has been held for too long.

use std::fmt;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use bytes::Bytes;
use comic_proto::frame;
use comic_proto::v1::ParametersChunk;
use parking_lot::Mutex;
use tokio::sync::{Notify, watch};

/// Bytes of parameters in a piece. Each piece is an allocation of its own, so a reader that stalls keeps one or two pieces,
/// or as many as hyper buffers if its network is stuck, and never the whole version. With pieces of 64 KiB a thousand readers
/// cost a fifth more processor time at five sixths of the throughput, and stalled readers cost the same memory.
const PIECE: usize = 40 * 1024;
const _: () = assert!(PIECE < comic_proto::FRAME_BYTES, "actors take a piece in one frame");
/// Versions that are held for readers.
const HELD: usize = 4;
/// Versions in memory: those held, the newest, the one that is being encoded, and the parameters that it is encoded from.
pub(crate) const VERSIONS: usize = HELD + 3;

/// How many versions are held for their readers, and how long.
#[derive(Clone, Copy, Debug)]
pub struct Holding {
    /// Versions that are held. It bounds the memory of the parameters for any number of readers.
    pub versions: usize,
    /// A newer version may replace a held one of which no reader took a piece for this time.
    pub idle: Duration,
    /// A newer version may replace a held one whose first reader began it this long ago, even if it is still read.
    pub longest: Duration,
}

impl Default for Holding {
    fn default() -> Self {
        Self { versions: HELD, idle: Duration::from_secs(5), longest: Duration::from_secs(60) }
    }
}

/// One version of the parameters, encoded once for all readers.
#[derive(Debug)]
pub struct Published {
    /// The number of the version.
    pub version: u64,
    /// Whether this is the end of the run.
    pub run_over: bool,
    /// Grows with every publication, also when the same version is published again.
    serial: u64,
    frames: Vec<Bytes>,
    /// Readers that began this publication and have not finished it.
    readers: AtomicUsize,
}

impl Published {
    fn new(learner_epoch: u64, version: u64, run_over: bool, serial: u64, payload: &Bytes) -> Self {
        // An empty payload has a piece too, because the piece says that the run is over.
        let offsets = (0..payload.len().max(1)).step_by(PIECE);
        let frames = offsets.map(|offset| {
            frame(&ParametersChunk {
                learner_epoch,
                version,
                total: payload.len() as u64,
                offset: offset as u64,
                data: payload.slice(offset..payload.len().min(offset + PIECE)),
                run_over,
            })
        });
        Self { version, run_over, serial, frames: frames.collect(), readers: AtomicUsize::new(0) }
    }

    /// Every [`ParametersChunk`] as gRPC sends it; there is at least one.
    pub fn frames(&self) -> &[Bytes] {
        &self.frames
    }
}

/// Publishes the trainer's parameters; a handle that can be cloned.
#[derive(Clone)]
pub struct Publisher {
    inner: Arc<Inner>,
    newest: watch::Sender<Option<Arc<Published>>>,
}

struct Inner {
    epoch: u64,
    holding: Holding,
    held: Mutex<Vec<Held>>,
    /// Notified when a held version is released.
    freed: Notify,
}

/// A version that is held for its readers.
struct Held {
    published: Arc<Published>,
    begun: Instant,
    /// When the last piece of it was taken.
    touched: Instant,
}

impl Publisher {
    /// A publisher of this learner epoch that has published nothing yet.
    pub fn new(epoch: u64) -> Self {
        Self::holding(epoch, Holding::default())
    }

    /// A publisher that holds versions as `holding` says.
    pub fn holding(epoch: u64, holding: Holding) -> Self {
        let inner = Inner { epoch, holding, held: Mutex::default(), freed: Notify::new() };
        Self { inner: Arc::new(inner), newest: watch::Sender::new(None) }
    }

    /// Makes this the newest version, without waiting for readers. Versions grow, but the same version may be published
    /// again. An older one is refused with an error in the log.
    pub fn publish(&self, version: u64, payload: &Bytes) {
        self.replace(version, false, payload);
    }

    /// Tells every reader that the run is over, under the newest version's number and without parameters. It is the last
    /// publication.
    pub fn end_run(&self) {
        self.replace(self.newest_version(), true, &Bytes::new());
    }

    fn replace(&self, version: u64, run_over: bool, payload: &Bytes) {
        let (newest, serial) = self.newest().map_or((0, 0), |published| (published.version, published.serial));
        if version < newest {
            tracing::error!(version, newest, "an older version is not published");
            return;
        }
        let published = Published::new(self.inner.epoch, version, run_over, serial + 1, payload);
        self.newest.send_replace(Some(Arc::new(published)));
    }

    /// The newest version; 0 before the first.
    pub fn newest_version(&self) -> u64 {
        self.newest().map_or(0, |published| published.version)
    }

    /// Whether the last publication said that the run is over.
    pub fn run_is_over(&self) -> bool {
        self.newest().is_some_and(|published| published.run_over)
    }

    /// The last publication.
    pub fn newest(&self) -> Option<Arc<Published>> {
        self.newest.borrow().clone()
    }

    /// The number of versions that are held for readers.
    pub fn held(&self) -> usize {
        self.inner.held.lock().len()
    }

    /// The learner epoch.
    pub fn epoch(&self) -> u64 {
        self.inner.epoch
    }

    /// A new reader, which begins with the newest version.
    pub fn subscribe(&self) -> Subscription {
        let (inner, newest) = (Arc::clone(&self.inner), self.newest.subscribe());
        Subscription { inner, newest, finished: 0, reading: None, run_over: false }
    }
}

impl fmt::Debug for Publisher {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let newest = self.newest_version();
        formatter.debug_struct("Publisher").field("epoch", &self.inner.epoch).field("newest", &newest).finish()
    }
}

/// A piece of a version, ready to send.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Piece {
    /// The version that it belongs to.
    pub version: u64,
    /// A [`ParametersChunk`], length-prefixed as gRPC sends it.
    pub frame: Bytes,
}

/// One reader of the parameters. It reads a version piece by piece, and skips versions that were replaced meanwhile.
pub struct Subscription {
    inner: Arc<Inner>,
    newest: watch::Receiver<Option<Arc<Published>>>,
    /// The serial number of the last publication that was read to its end.
    finished: u64,
    reading: Option<Reading>,
    /// Whether the end of the run was read.
    run_over: bool,
}

/// A version that a reader has begun. It counts among the version's readers until it is dropped.
struct Reading {
    inner: Arc<Inner>,
    /// Weak, so that a stalled reader does not keep the version in memory.
    published: Weak<Published>,
    /// The index of the next piece.
    index: usize,
}

impl Drop for Reading {
    fn drop(&mut self) {
        let Some(published) = self.published.upgrade() else { return };
        if published.readers.fetch_sub(1, Ordering::AcqRel) == 1 {
            self.inner.held.lock().retain(|held| held.published.readers.load(Ordering::Acquire) > 0);
            self.inner.freed.notify_waiters();
        }
    }
}

/// Whether a reader could begin a version.
enum Begun {
    Yes,
    NothingNew,
    AllPlacesTaken,
}

impl Subscription {
    /// The next piece: of the version that was begun, and then of the newest version that was not read yet. Waits for a new
    /// version. `None` after the end of the run, or when there is no publisher any more. Cancel-safe.
    pub async fn next(&mut self) -> Option<Piece> {
        loop {
            if let Some(piece) = self.piece() {
                return Some(piece);
            }
            if self.run_over {
                return None;
            }
            let inner = Arc::clone(&self.inner);
            // Made before `begin` looks for a place, so that a place that becomes free in between is not missed.
            let freed = inner.freed.notified();
            match self.begin() {
                Begun::Yes => {}
                Begun::NothingNew => self.newest.changed().await.ok()?,
                Begun::AllPlacesTaken => tokio::select! {
                    () = freed => {}
                    () = tokio::time::sleep(inner.holding.idle) => {}
                },
            }
        }
    }

    /// The message that the run is over, if that was published last. It is sent even when the server closes.
    pub fn end_of_run(&mut self) -> Option<Piece> {
        if !self.newest.borrow().as_ref().is_some_and(|published| published.run_over) {
            return None;
        }
        if self.newest.has_changed().unwrap_or(false) {
            self.begin();
        }
        self.piece()
    }

    /// Begins the newest version if it can be held, or else the newest version that is held already.
    fn begin(&mut self) -> Begun {
        // The lock is taken before the newest version is read, so that no older version is begun.
        let mut held = self.inner.held.lock();
        let Some(newest) = self.newest.borrow_and_update().clone() else { return Begun::NothingNew };
        if newest.serial == self.finished {
            return Begun::NothingNew;
        }
        let (now, holding) = (Instant::now(), self.inner.holding);
        if held.iter().all(|held| held.published.serial != newest.serial) {
            // The end of the run is one piece, and every reader must get it.
            let small = newest.frames.len() == 1;
            let replaceable = |held: &Held| {
                now.duration_since(held.touched) >= holding.idle || now.duration_since(held.begun) >= holding.longest
            };
            if held.len() >= holding.versions
                && let Some(place) = held.iter().position(replaceable)
            {
                held.remove(place);
            }
            if held.len() < holding.versions || small {
                held.push(Held { published: newest, begun: now, touched: now });
            }
        }
        let unseen = held.iter_mut().filter(|held| held.published.serial > self.finished);
        let Some(best) = unseen.max_by_key(|held| held.published.serial) else { return Begun::AllPlacesTaken };
        // Under the lock, because a version without readers is released.
        best.published.readers.fetch_add(1, Ordering::AcqRel);
        let published = Arc::downgrade(&best.published);
        drop(held);
        self.reading = Some(Reading { inner: Arc::clone(&self.inner), published, index: 0 });
        Begun::Yes
    }

    /// The next piece of the version that was begun, if it is still held.
    fn piece(&mut self) -> Option<Piece> {
        let reading = self.reading.as_mut()?;
        let Some(published) = reading.published.upgrade() else {
            // The reader stalled, and a newer version replaced this one.
            self.reading = None;
            return None;
        };
        let frame = published.frames.get(reading.index)?.clone();
        reading.index += 1;
        if reading.index == published.frames.len() {
            self.reading = None;
            self.finished = published.serial;
            self.run_over = published.run_over;
        } else if let Some(held) =
            self.inner.held.lock().iter_mut().find(|held| held.published.serial == published.serial)
        {
            held.touched = Instant::now();
        }
        Some(Piece { version: published.version, frame })
    }
}

impl fmt::Debug for Subscription {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Subscription").field("finished", &self.finished).finish_non_exhaustive()
    }
}
