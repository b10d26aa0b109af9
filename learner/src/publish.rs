//! Parameters down to the actors: always the newest version, encoded once and one copy in memory for all who read it.
//!
//! An actor that reads on finishes the version it began, however many come meanwhile: if it started over with each of
//! them, a slow one would never have any. An actor that stalls must not keep its version alive. So a few versions are
//! *held* for their readers, readers themselves hold nothing, and the place of a version that nobody gets on with, or
//! that takes too long, is given to a newer one when it is needed.

use std::fmt;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use bytes::Bytes;
use comic_proto::frame;
use comic_proto::v1::{Behaviour, ParametersChunk};
use tokio::sync::{Notify, watch};

/// Bytes of parameters in a piece. Each piece is memory of its own, so a reader that stalls for ever holds one or two
/// pieces, or where its network is stuck as many as hyper buffers, and never the version they are of. With 64 KiB a thousand
/// readers cost a fifth more processor time at five sixths of the pace, and stalled ones the same memory.
const PIECE: usize = 40 * 1024;
const _: () = assert!(PIECE < comic_proto::FRAME_BYTES, "actors take a piece in one frame");
/// Versions that readers can be in the middle of.
const HELD: usize = 4;
/// Versions in memory: those held, the newest, the one that is just being made, and what it is made of.
pub(crate) const VERSIONS: usize = HELD + 3;

/// How many versions are held for their readers, and how long.
#[derive(Clone, Copy, Debug)]
pub struct Holding {
    /// Versions that readers can be in the middle of: what parameters take of memory, however many read.
    pub versions: usize,
    /// A version of which nobody took a piece for so long gives its place to a newer one.
    pub idle: Duration,
    /// A version that was begun so long ago gives its place to a newer one, though somebody still reads it.
    pub longest: Duration,
}

impl Default for Holding {
    fn default() -> Self {
        Self { versions: HELD, idle: Duration::from_secs(5), longest: Duration::from_secs(60) }
    }
}

/// One version of the parameters, encoded once for everybody.
#[derive(Debug)]
pub struct Published {
    /// Counts publications.
    pub version: u64,
    /// How actors act with it; unspecified when the run is over.
    pub behaviour: Behaviour,
    /// Whether this is the end of the run.
    pub run_over: bool,
    /// Grows with every publication, of the same version again too.
    serial: u64,
    frames: Vec<Bytes>,
    /// Who is in the middle of it.
    readers: AtomicUsize,
}

impl Published {
    /// `behaviour` is absent at the end of the run.
    fn new(learner_epoch: u64, version: u64, behaviour: Option<Behaviour>, serial: u64, payload: &Bytes) -> Self {
        let (behaviour, run_over) = (behaviour.unwrap_or_default(), behaviour.is_none());
        // An empty payload has a piece too: it says how to act.
        let offsets = (0..payload.len().max(1)).step_by(PIECE);
        let frames = offsets.map(|offset| {
            frame(&ParametersChunk {
                learner_epoch,
                version,
                behaviour: behaviour.into(),
                total: payload.len() as u64,
                offset: offset as u64,
                data: payload.slice(offset..payload.len().min(offset + PIECE)),
                run_over,
            })
        });
        Self { version, behaviour, run_over, serial, frames: frames.collect(), readers: AtomicUsize::new(0) }
    }

    /// Every [`ParametersChunk`] as gRPC sends it, at least one.
    pub fn frames(&self) -> &[Bytes] {
        &self.frames
    }
}

/// Where the trainer puts new parameters; a handle that can be cloned.
#[derive(Clone)]
pub struct Publisher {
    inner: Arc<Inner>,
    newest: watch::Sender<Option<Arc<Published>>>,
}

struct Inner {
    epoch: u64,
    holding: Holding,
    held: Mutex<Vec<Held>>,
    /// A place among the held is free.
    freed: Notify,
}

/// A version that somebody reads.
struct Held {
    published: Arc<Published>,
    begun: Instant,
    /// When the last piece of it was taken.
    touched: Instant,
}

impl Inner {
    fn held(&self) -> MutexGuard<'_, Vec<Held>> {
        // Nothing panics while it holds this lock.
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Publisher {
    /// A publisher that has published nothing yet, in this life of the learner.
    pub fn new(epoch: u64) -> Self {
        Self::holding(epoch, Holding::default())
    }

    /// One that holds versions otherwise than by default.
    pub fn holding(epoch: u64, holding: Holding) -> Self {
        let inner = Inner { epoch, holding, held: Mutex::default(), freed: Notify::new() };
        Self { inner: Arc::new(inner), newest: watch::Sender::new(None) }
    }

    /// Makes this the newest version, without waiting for readers. Versions grow, but the same version may be published
    /// again. An older one is refused with an error in the log.
    pub fn publish(&self, version: u64, behaviour: Behaviour, payload: &Bytes) {
        self.replace(version, Some(behaviour), payload);
    }

    /// Tells every reader that the run is over, under the newest version's number and without parameters. It is the last
    /// publication.
    pub fn end_run(&self) {
        self.replace(self.newest_version(), None, &Bytes::new());
    }

    fn replace(&self, version: u64, behaviour: Option<Behaviour>, payload: &Bytes) {
        let (newest, serial) = self.newest().map_or((0, 0), |published| (published.version, published.serial));
        if version < newest {
            tracing::error!(version, newest, "an older version is not published");
            return;
        }
        let published = Published::new(self.inner.epoch, version, behaviour, serial + 1, payload);
        self.newest.send_replace(Some(Arc::new(published)));
    }

    /// The newest version; 0 before the first.
    pub fn newest_version(&self) -> u64 {
        self.newest().map_or(0, |published| published.version)
    }

    /// What was published last.
    pub fn newest(&self) -> Option<Arc<Published>> {
        self.newest.borrow().clone()
    }

    /// Versions that are in memory because somebody reads them, or began to.
    pub fn held(&self) -> usize {
        self.inner.held().len()
    }

    /// The life of the learner it belongs to.
    pub fn epoch(&self) -> u64 {
        self.inner.epoch
    }

    /// A reader that begins with the newest version.
    pub fn subscribe(&self) -> Subscription {
        let (inner, newest) = (Arc::clone(&self.inner), self.newest.subscribe());
        Subscription { inner, newest, finished: 0, reading: None, left: false }
    }
}

impl fmt::Debug for Publisher {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let newest = self.newest_version();
        formatter.debug_struct("Publisher").field("epoch", &self.inner.epoch).field("newest", &newest).finish()
    }
}

/// A piece of a version, ready to be sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Piece {
    /// The version it is of.
    pub version: u64,
    /// A [`ParametersChunk`], length-prefixed as gRPC sends it.
    pub frame: Bytes,
}

/// One actor's view of the parameters, in pieces. The versions that came and went while it read are skipped.
pub struct Subscription {
    inner: Arc<Inner>,
    newest: watch::Receiver<Option<Arc<Published>>>,
    /// The last publication it read to its end.
    finished: u64,
    reading: Option<Reading>,
    left: bool,
}

/// A version being read, counted among its readers.
struct Reading {
    inner: Arc<Inner>,
    /// Weak, so that a stalled reader keeps nothing alive.
    published: Weak<Published>,
    /// Of its next piece.
    index: usize,
}

impl Drop for Reading {
    fn drop(&mut self) {
        let Some(published) = self.published.upgrade() else { return };
        if published.readers.fetch_sub(1, Ordering::AcqRel) == 1 {
            self.inner.held().retain(|held| held.published.readers.load(Ordering::Acquire) > 0);
            self.inner.freed.notify_waiters();
        }
    }
}

/// Whether a reader could begin.
enum Begun {
    Yes,
    NothingNew,
    NoRoom,
}

impl Subscription {
    /// The next piece: the rest of a version begun, then the newest one not seen yet, waiting for it if need be.
    /// `None` after the end of the run, or when there is no publisher any more. Cancel-safe.
    pub async fn next(&mut self) -> Option<Piece> {
        loop {
            if let Some(piece) = self.piece() {
                return Some(piece);
            }
            if self.left {
                return None;
            }
            let inner = Arc::clone(&self.inner);
            // From here on, before looking: a place that becomes free in between is not missed.
            let freed = inner.freed.notified();
            match self.begin() {
                Begun::Yes => {}
                Begun::NothingNew => self.newest.changed().await.ok()?,
                Begun::NoRoom => tokio::select! {
                    () = freed => {}
                    () = tokio::time::sleep(inner.holding.idle) => {}
                },
            }
        }
    }

    /// The message that the run is over, if that was published last. It is sent even when the server closes.
    pub fn farewell(&mut self) -> Option<Piece> {
        if !self.newest.borrow().as_ref().is_some_and(|published| published.run_over) {
            return None;
        }
        if self.newest.has_changed().unwrap_or(false) {
            self.begin();
        }
        self.piece()
    }

    /// Begins the newest version if there is room to hold it, or else the newest that is held already.
    fn begin(&mut self) -> Begun {
        // Locked first: what is begun is the newest then, too.
        let mut held = self.inner.held();
        let Some(newest) = self.newest.borrow_and_update().clone() else { return Begun::NothingNew };
        if newest.serial == self.finished {
            return Begun::NothingNew;
        }
        let (now, holding) = (Instant::now(), self.inner.holding);
        if held.iter().all(|held| held.published.serial != newest.serial) {
            // The last word is one piece, and heard by everybody.
            let small = newest.frames.len() == 1;
            let given_up = |held: &Held| {
                now.duration_since(held.touched) >= holding.idle || now.duration_since(held.begun) >= holding.longest
            };
            if held.len() >= holding.versions
                && let Some(place) = held.iter().position(given_up)
            {
                held.remove(place);
            }
            if held.len() < holding.versions || small {
                held.push(Held { published: newest, begun: now, touched: now });
            }
        }
        let unseen = held.iter_mut().filter(|held| held.published.serial > self.finished);
        let Some(best) = unseen.max_by_key(|held| held.published.serial) else { return Begun::NoRoom };
        // Under the lock: it is let go of when its last reader is done.
        best.published.readers.fetch_add(1, Ordering::AcqRel);
        let published = Arc::downgrade(&best.published);
        drop(held);
        self.reading = Some(Reading { inner: Arc::clone(&self.inner), published, index: 0 });
        Begun::Yes
    }

    fn piece(&mut self) -> Option<Piece> {
        let reading = self.reading.as_mut()?;
        let Some(published) = reading.published.upgrade() else {
            // It stalled, and its version had to make room.
            self.reading = None;
            return None;
        };
        let frame = published.frames.get(reading.index)?.clone();
        reading.index += 1;
        if reading.index == published.frames.len() {
            self.reading = None;
            self.finished = published.serial;
            self.left = published.run_over;
        } else if let Some(held) = self.inner.held().iter_mut().find(|held| held.published.serial == published.serial) {
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
