//! Parameters down to the actors: always the newest version, one copy in memory for all who read it.

use std::collections::VecDeque;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError, Weak};

use bytes::Bytes;
use comic_proto::v1::{Behaviour, ParametersChunk};
use tokio::sync::watch;

/// Bytes of a piece. Measured with 1000 readers: 64 KiB pieces are the fastest, and a stalled reader holds one.
pub(crate) const CHUNK: usize = 64 * 1024;
/// Versions kept for readers in the middle of them. One that falls further behind starts over with the newest, so
/// memory is bounded however many readers stall.
pub(crate) const KEPT: usize = 8;

/// One version of the parameters, as actors get it.
#[derive(Clone, Debug)]
pub struct Published {
    /// The life of the learner that made it.
    pub epoch: u64,
    /// Counts publications.
    pub version: u64,
    /// How actors act with it.
    pub behaviour: Behaviour,
    /// The policy's parameters, safetensors.
    pub payload: Bytes,
}

impl Published {
    /// The piece that starts at `offset`; every payload has one at 0, an empty payload too.
    fn chunk(&self, offset: usize) -> ParametersChunk {
        let end = offset.saturating_add(CHUNK).min(self.payload.len());
        ParametersChunk {
            learner_epoch: self.epoch,
            version: self.version,
            behaviour: self.behaviour.into(),
            total: self.payload.len() as u64,
            offset: offset as u64,
            data: self.payload.slice(offset.min(end)..end),
        }
    }
}

/// Where the trainer puts new parameters; a handle that can be cloned.
#[derive(Clone)]
pub struct Publisher {
    inner: Arc<Inner>,
}

struct Inner {
    epoch: u64,
    newest: watch::Sender<Option<Arc<Published>>>,
    kept: Mutex<VecDeque<Arc<Published>>>,
}

impl Publisher {
    /// A publisher that has published nothing yet, in this life of the learner.
    pub fn new(epoch: u64) -> Self {
        let inner = Inner { epoch, newest: watch::Sender::new(None), kept: Mutex::new(VecDeque::new()) };
        Self { inner: Arc::new(inner) }
    }

    /// Makes this the newest version; nobody waits for anybody. Versions grow, except that the same version may come
    /// again with another behaviour ([`Behaviour::Leave`] at the end); an older one is refused with an error in the log.
    pub fn publish(&self, version: u64, behaviour: Behaviour, payload: Bytes) {
        let published = Arc::new(Published { epoch: self.inner.epoch, version, behaviour, payload });
        let mut kept = self.inner.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let newest = self.newest_version();
        if version < newest {
            tracing::error!(version, newest, "an older version is not published");
            return;
        }
        if kept.len() == KEPT {
            kept.pop_front();
        }
        kept.push_back(published.clone());
        self.inner.newest.send_replace(Some(published));
    }

    /// The newest version; 0 before the first.
    pub fn newest_version(&self) -> u64 {
        self.newest().map_or(0, |published| published.version)
    }

    /// What was published last.
    pub fn newest(&self) -> Option<Arc<Published>> {
        self.inner.newest.borrow().clone()
    }

    /// The life of the learner it belongs to.
    pub fn epoch(&self) -> u64 {
        self.inner.epoch
    }

    /// A reader that begins with the newest version.
    pub fn subscribe(&self) -> Subscription {
        let mut newest = self.inner.newest.subscribe();
        newest.mark_changed();
        Subscription { newest, reading: None, left: false }
    }
}

impl fmt::Debug for Publisher {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let newest = self.newest_version();
        formatter.debug_struct("Publisher").field("epoch", &self.inner.epoch).field("newest", &newest).finish()
    }
}

/// One actor's view of the parameters, in pieces. The versions that came and went while it read are skipped.
#[derive(Debug)]
pub struct Subscription {
    newest: watch::Receiver<Option<Arc<Published>>>,
    /// The version being read and where its next piece starts. Weak, so that a stalled reader keeps nothing alive.
    reading: Option<(Weak<Published>, usize)>,
    left: bool,
}

impl Subscription {
    /// The next piece: the rest of a version begun, then the newest one not seen yet, waiting for it if need be.
    /// `None` after the last piece of a [`Behaviour::Leave`], or when there is no publisher any more. Cancel-safe.
    pub async fn next(&mut self) -> Option<ParametersChunk> {
        loop {
            if let Some(chunk) = self.piece() {
                return Some(chunk);
            }
            if self.left {
                return None;
            }
            self.newest.changed().await.ok()?;
            self.begin_newest();
        }
    }

    /// The next piece of [`Behaviour::Leave`], if that is what was published last: what is still worth sending when
    /// the server closes.
    pub fn farewell(&mut self) -> Option<ParametersChunk> {
        let leaving = |published: &Arc<Published>| published.behaviour == Behaviour::Leave;
        if !self.newest.borrow().as_ref().is_some_and(leaving) {
            return None;
        }
        if self.newest.has_changed().unwrap_or(false) {
            self.begin_newest();
        }
        self.piece()
    }

    fn begin_newest(&mut self) {
        let newest = self.newest.borrow_and_update();
        self.reading = newest.as_ref().map(|published| (Arc::downgrade(published), 0));
    }

    fn piece(&mut self) -> Option<ParametersChunk> {
        let (reading, offset) = self.reading.take()?;
        let Some(published) = reading.upgrade() else {
            // Too far behind: this version is gone, and there is a newer one.
            self.begin_newest();
            return self.piece();
        };
        let chunk = published.chunk(offset);
        let next = offset + chunk.data.len();
        if next < published.payload.len() {
            self.reading = Some((reading, next));
        } else {
            self.left = published.behaviour == Behaviour::Leave;
        }
        Some(chunk)
    }
}
