//! What the actors of a crowd count.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Instant;

use parking_lot::Mutex;
use serde_json::{Value, json};

/// Not waiting.
pub(super) const NEVER: u64 = u64::MAX;

/// What an actor waits for.
#[derive(Clone, Copy, Debug)]
pub(super) enum Awaited {
    Acknowledgement,
    Version,
}

/// The counters of all actors together.
#[derive(Debug)]
pub(super) struct Statistics {
    start: Instant,
    /// Connections now.
    pub(super) connected: AtomicU64,
    /// Connections made so far.
    pub(super) connections: AtomicU64,
    pub(super) stalled: AtomicU64,
    pub(super) failures: AtomicU64,
    pub(super) acked: AtomicU64,
    pub(super) taken: AtomicU64,
    pub(super) stale: AtomicU64,
    bytes: AtomicU64,
    versions: AtomicU64,
    newest: AtomicU64,
    lags: Mutex<Lags>,
    /// For each actor and each [`Awaited`]: since when it waits, in milliseconds from the start, or [`NEVER`].
    waits: Vec<[AtomicU64; 2]>,
    /// The longest wait for each [`Awaited`], milliseconds.
    longest: [AtomicU64; 2],
}

/// How old versions were when an actor had read all of them.
#[derive(Debug, Default)]
struct Lags {
    versions: Vec<f64>,
    seconds: Vec<f64>,
    /// By version: when the first actor read the first piece of it.
    announced: Vec<Option<Instant>>,
}

impl Statistics {
    pub(super) fn new(actors: usize) -> Self {
        Self {
            start: Instant::now(),
            connected: AtomicU64::default(),
            connections: AtomicU64::default(),
            stalled: AtomicU64::default(),
            failures: AtomicU64::default(),
            acked: AtomicU64::default(),
            taken: AtomicU64::default(),
            stale: AtomicU64::default(),
            bytes: AtomicU64::default(),
            versions: AtomicU64::default(),
            newest: AtomicU64::default(),
            lags: Mutex::default(),
            waits: (0..actors).map(|_| [const { AtomicU64::new(NEVER) }; 2]).collect(),
            longest: Default::default(),
        }
    }

    pub(super) fn to_json(&self) -> Value {
        let now = self.now();
        for waits in &self.waits {
            for (since, longest) in waits.iter().zip(&self.longest) {
                longest.fetch_max(now.saturating_sub(since.load(Relaxed)), Relaxed);
            }
        }
        let lags = self.lags.lock();
        let [ack, version] = &self.longest;
        json!({
            "connected": self.connected.load(Relaxed),
            "connections": self.connections.load(Relaxed),
            "stalled": self.stalled.load(Relaxed),
            "failures": self.failures.load(Relaxed),
            "acked": self.acked.load(Relaxed),
            "taken": self.taken.load(Relaxed),
            "stale": self.stale.load(Relaxed),
            "bytes": self.bytes.load(Relaxed),
            "versions": self.versions.load(Relaxed),
            "lag_versions": quantiles(&lags.versions),
            "lag_seconds": quantiles(&lags.seconds),
            "longest_without_an_acknowledgement": ack.load(Relaxed) as f64 / 1e3,
            "longest_without_a_version": version.load(Relaxed) as f64 / 1e3,
        })
    }

    /// Discards the lags and the longest waits measured so far.
    pub(super) fn reset(&self) {
        let mut lags = self.lags.lock();
        (lags.versions, lags.seconds) = (Vec::new(), Vec::new());
        self.longest.iter().for_each(|longest| longest.store(0, Relaxed));
    }

    /// Milliseconds since the start.
    pub(super) fn now(&self) -> u64 {
        self.start.elapsed().as_millis() as u64
    }

    /// Ends a wait of actor `index` and begins the next.
    pub(super) fn arrived(&self, index: usize, awaited: Awaited) {
        let now = self.now();
        let since = self.waits[index][awaited as usize].swap(now, Relaxed);
        self.longest[awaited as usize].fetch_max(now.saturating_sub(since), Relaxed);
    }

    /// Sets since when actor `index` waits for an acknowledgement and for a version.
    pub(super) fn wait_from(&self, index: usize, since: [u64; 2]) {
        for (wait, since) in self.waits[index].iter().zip(since) {
            wait.store(since, Relaxed);
        }
    }

    /// Counts `more` bytes after `read` ones, and the versions of `size` bytes that they complete.
    pub(super) fn count_bytes(&self, read: &mut u64, more: u64, size: u64) {
        self.versions.fetch_add((*read + more) / size - *read / size, Relaxed);
        self.bytes.fetch_add(more, Relaxed);
        *read += more;
    }

    /// Counts a piece of a version's parameters.
    pub(super) fn count_piece(&self, version: u64, bytes: u64, is_first: bool, is_last: bool) {
        self.bytes.fetch_add(bytes, Relaxed);
        let newest = self.newest.fetch_max(version, Relaxed).max(version);
        if is_first || is_last {
            let mut lags = self.lags.lock();
            let place = version as usize;
            if lags.announced.len() <= place {
                lags.announced.resize(place + 1, None);
            }
            let announced = *lags.announced[place].get_or_insert_with(Instant::now);
            if is_last {
                lags.versions.push((newest - version) as f64);
                lags.seconds.push(announced.elapsed().as_secs_f64());
            }
        }
        if is_last {
            self.versions.fetch_add(1, Relaxed);
        }
    }
}

/// Adds one to a counter for as long as it exists.
pub(super) struct Present<'a>(&'a AtomicU64);

impl<'a> Present<'a> {
    pub(super) fn new(count: &'a AtomicU64) -> Self {
        count.fetch_add(1, Relaxed);
        Self(count)
    }
}

impl Drop for Present<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Relaxed);
    }
}

fn quantiles(values: &[f64]) -> Value {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    let at = |percent: usize| values.get(values.len().saturating_sub(1) * percent / 100).copied();
    json!({ "p50": at(50), "p99": at(99), "max": at(100), "count": values.len() })
}
