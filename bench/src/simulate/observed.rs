//! What happens in a simulation.

use std::collections::{BTreeMap, VecDeque};
use std::ops::AddAssign;

use serde::Serialize;

use super::distribution::Distribution;

/// Unrolls that were dropped as stale, by where they were.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub(super) struct Dropped {
    /// When the learner read them.
    pub(super) arriving: u64,
    /// When there was a slot, after they had waited for it.
    pub(super) waiting: u64,
    /// In a batch, when the learner took it.
    pub(super) in_a_batch: u64,
}

/// A version of the parameters.
#[derive(Clone, Copy, Debug)]
struct Version {
    at: f64,
    /// Actors that have it or a newer one.
    holders: usize,
    measured: bool,
}

/// Counts from [`begin`](Self::begin) to [`end`](Self::end), except where a field says otherwise.
#[derive(Debug, Default)]
pub(super) struct Observed {
    actors: usize,
    measuring: bool,
    from: f64,
    pub(super) seconds: f64,
    /// Actors that have begun their first round.
    acting_actors: Vec<bool>,
    not_acting: usize,
    start: Option<f64>,
    /// The newest version; the first is 1.
    newest: u64,
    /// The versions that an actor does not have yet, nor a newer one. The last is the newest.
    spreading: VecDeque<Version>,
    /// Versions that were published.
    pub(super) versions: u64,
    /// Seconds from the publication of each of them until every actor had it or a newer one, also after the end.
    publications: Distribution,
    pub(super) unrolls: u64,
    pub(super) dropped: Dropped,
    /// Unrolls by age in versions when they were trained on.
    pub(super) ages: BTreeMap<u64, u64>,
    /// Seconds of updates.
    pub(super) learning: f64,
    /// Seconds of rounds, of all workers together.
    pub(super) acting: f64,
    pub(super) waits_for_acknowledgements: Distribution,
    pub(super) waits_for_versions: Distribution,
    /// Seconds from the publication of a version until an actor had it, and how many newer versions there were then.
    pub(super) reads: Distribution,
    pub(super) late: Distribution,
    /// Versions that actors had begun to read and lost.
    pub(super) cut_off: u64,
    /// In and out.
    pub(super) bytes: [f64; 2],
    /// Most unrolls that waited in one learner and its windows, since the start.
    pub(super) most_waiting: usize,
    /// Most versions in the memory of one learner, since the start.
    pub(super) most_held: usize,
}

impl AddAssign for Dropped {
    fn add_assign(&mut self, other: Self) {
        self.arriving += other.arriving;
        self.waiting += other.waiting;
        self.in_a_batch += other.in_a_batch;
    }
}

impl Dropped {
    pub(super) fn all(self) -> u64 {
        self.arriving + self.waiting + self.in_a_batch
    }
}

impl Observed {
    pub(super) fn new(actors: usize) -> Self {
        Self { actors, acting_actors: vec![false; actors], not_acting: actors, ..Self::default() }
    }

    pub(super) fn begin(&mut self, now: f64) {
        (self.measuring, self.from) = (true, now);
    }

    pub(super) fn end(&mut self, now: f64) {
        (self.measuring, self.seconds) = (false, now - self.from);
    }

    /// When the last actor began its first round.
    pub(super) fn start(&self) -> Option<f64> {
        self.start
    }

    /// Whether an actor has not yet got a version that was published while measuring.
    pub(super) fn awaits_a_version(&self) -> bool {
        self.spreading.iter().any(|version| version.measured)
    }

    /// Seconds from the publication of each version until every actor had it or a newer one; `None` if the simulation
    /// ended before that.
    pub(super) fn publications(&self) -> Option<&Distribution> {
        (!self.awaits_a_version()).then_some(&self.publications)
    }

    pub(super) fn published(&mut self, now: f64) {
        self.newest += 1;
        self.versions += u64::from(self.measuring);
        self.spreading.push_back(Version { at: now, holders: 0, measured: self.measuring });
    }

    /// An actor has read this version, after the version `before`.
    pub(super) fn received(&mut self, now: f64, before: u64, version: u64) {
        // Every actor has at least this one.
        let complete = self.newest - self.spreading.len() as u64;
        let mut published = now;
        for passed in self.spreading.range_mut((before - complete) as usize..(version - complete) as usize) {
            passed.holders += 1;
            published = passed.at;
        }
        if self.measuring {
            self.reads.add(now - published);
            self.late.add((self.newest - version) as f64);
        }
        while let Some(version) = self.spreading.pop_front_if(|version| version.holders == self.actors) {
            if version.measured {
                self.publications.add(now - version.at);
            }
        }
    }

    /// A worker has begun a round after it has waited for a version; the first one of its own is of the actor `first`.
    pub(super) fn began(&mut self, now: f64, first: Option<usize>, waited: f64) {
        if let Some(actor) = first {
            if !std::mem::replace(&mut self.acting_actors[actor], true) {
                self.not_acting -= 1;
            }
            if self.not_acting == 0 && self.start.is_none() {
                self.start = Some(now);
            }
        } else if self.measuring {
            self.waits_for_versions.add(waited);
        }
    }

    pub(super) fn acted(&mut self, seconds: f64) {
        if self.measuring {
            self.acting += seconds;
        }
    }

    /// The learner has answered for a whole round.
    pub(super) fn acknowledged(&mut self, waited: f64) {
        if self.measuring {
            self.waits_for_acknowledgements.add(waited);
        }
    }

    pub(super) fn drop(&mut self, dropped: Dropped) {
        if self.measuring {
            self.dropped += dropped;
        }
    }

    /// An update has lasted from `since` until now.
    pub(super) fn learned(&mut self, since: f64, now: f64) {
        if self.measuring {
            self.learning += now - since.max(self.from);
        }
    }

    pub(super) fn trained(&mut self, ages: impl Iterator<Item = u64>) {
        if self.measuring {
            for age in ages {
                self.unrolls += 1;
                *self.ages.entry(age).or_default() += 1;
            }
        }
    }

    pub(super) fn cut_off(&mut self, readers: usize) {
        if self.measuring {
            self.cut_off += readers as u64;
        }
    }

    pub(super) fn waiting(&mut self, unrolls: usize) {
        self.most_waiting = self.most_waiting.max(unrolls);
    }

    pub(super) fn held(&mut self, versions: usize) {
        self.most_held = self.most_held.max(versions);
    }
}
