//! Which actors are present, and in which state.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use tonic::Status;

use super::peer::Owner;

/// An actor that joined must open its streams within this time. An actor whose connection ended must come back within it, or
/// in lockstep another actor gets its environments.
const GRACE: Duration = Duration::from_secs(30);
/// An actor is slow when the learner waits for it and hears nothing for this time.
const SLOW: Duration = Duration::from_secs(60);
/// How long a lost actor is reported.
const REMEMBERED: Duration = Duration::from_secs(600);
/// The largest number of actors that are remembered.
const CAPACITY: usize = 65_536;

/// Numbers of actors by their state.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Census {
    /// Connected, and heard lately or waiting for the learner.
    pub(crate) alive: u64,
    /// Connected, and silent although the learner waits for them.
    pub(crate) slow: u64,
    /// Not connected any more.
    pub(crate) lost: u64,
    /// Unrolls that wait for a place in a batch.
    pub(crate) waiting: u64,
}

/// The processes that joined, by incarnation.
#[derive(Debug)]
pub(super) struct Roster {
    limit: usize,
    actors: Mutex<HashMap<u64, Actor>>,
}

/// Whether an actor may join.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Joined {
    Welcome,
    /// There are too many actors.
    Full,
    /// A newer process of the same name took its place.
    Superseded,
    /// The name belongs to another certificate.
    Foreign,
}

/// The name under which a process joins.
#[derive(Clone, Copy, Debug)]
pub(super) struct Name<'a> {
    /// It stays over restarts. Empty if the process has none.
    pub(super) text: &'a str,
    /// Who shows the name, if a certificate says so. The name is theirs as long as one of their actors is remembered.
    pub(super) owner: Option<Owner>,
}

#[derive(Clone, Debug)]
struct Actor {
    /// The same name identifies the actor after its restarts. An actor may have no name: the empty one.
    name: String,
    owner: Option<Owner>,
    /// The order in which processes of the same name replace each other: their indices. A process without an index is the
    /// newest.
    order: u64,
    /// A newer process of the same name joined.
    superseded: bool,
    /// It found no free environment. It will join again, and does not count as present until then.
    standing_by: bool,
    /// Open streams of parameters.
    streams: u32,
    /// When it last opened one.
    opened: Option<Instant>,
    /// Its unrolls that wait for a place in a batch.
    waiting: u32,
    heard: Instant,
    /// When its last stream ended, if nothing was heard of it since.
    gone: Option<Instant>,
}

impl Actor {
    fn is_present(&self, now: Instant) -> bool {
        let lately = self.gone.is_none() && now.duration_since(self.heard) < GRACE;
        !self.superseded && !self.standing_by && (self.streams > 0 || lately)
    }

    fn is_slow(&self, now: Instant) -> bool {
        self.waiting == 0 && now.duration_since(self.heard) >= SLOW
    }

    fn is_remembered(&self, now: Instant) -> bool {
        self.streams > 0 || self.is_present(now) || now.duration_since(self.gone.unwrap_or(self.heard)) < REMEMBERED
    }
}

impl Roster {
    pub(super) fn new(limit: usize) -> Self {
        Self { limit, actors: Mutex::default() }
    }

    /// Lets an actor join and supersedes older processes of its name, or says why it cannot join. An actor that is present
    /// always stays. An actor that comes back names the index that it had: after a restart of the learner only the indices
    /// tell which of two processes is the newer.
    pub(super) fn join(&self, incarnation: u64, name: Name<'_>, had: Option<u64>, now: Instant) -> Joined {
        let Name { text: name, owner } = name;
        let mut actors = self.actors.lock();
        let namesake = |other: u64, actor: &Actor| other != incarnation && !name.is_empty() && actor.name == name;
        let is_foreign = |other: u64, actor: &Actor| namesake(other, actor) && actor.owner != owner;
        if actors.iter().any(|(other, actor)| is_foreign(*other, actor) && actor.is_remembered(now)) {
            return Joined::Foreign;
        }
        match actors.get_mut(&incarnation) {
            Some(actor) if actor.superseded => return Joined::Superseded,
            Some(actor) if actor.is_present(now) => {
                (actor.heard, actor.owner) = (now, owner);
                return Joined::Welcome;
            }
            _ => {}
        }
        let order = had.unwrap_or(u64::MAX);
        let mut namesakes = actors.iter().filter(|(other, actor)| namesake(**other, actor));
        if namesakes.any(|(_, actor)| actor.order > order && !actor.superseded) {
            return Joined::Superseded;
        }
        let older = |other: u64, actor: &Actor| namesake(other, actor) && actor.order <= order;
        let rivals = actors.iter().filter(|(other, actor)| actor.is_present(now) && !older(**other, actor));
        if rivals.count() >= self.limit {
            return Joined::Full;
        }
        for (other, actor) in actors.iter_mut() {
            if older(*other, actor) && !actor.superseded {
                actor.superseded = true;
                tracing::warn!(
                    name,
                    older = format_args!("{other:016x}"),
                    newer = format_args!("{incarnation:016x}"),
                    "an actor is superseded"
                );
            }
        }
        if actors.len() >= CAPACITY {
            actors.retain(|_, actor| actor.streams > 0 || actor.is_present(now));
        } else {
            actors.retain(|_, actor| actor.is_remembered(now));
        }
        let name = name.to_owned();
        let actor = Actor {
            name,
            owner,
            order,
            superseded: false,
            standing_by: false,
            streams: 0,
            opened: None,
            waiting: 0,
            heard: now,
            gone: None,
        };
        let actor = actors.entry(incarnation).or_insert(actor);
        (actor.heard, actor.gone, actor.standing_by, actor.owner) = (now, None, false, owner);
        Joined::Welcome
    }

    /// Marks an actor that joined and found no free environment. It no longer counts as present, but it still supersedes older
    /// processes of its name.
    pub(super) fn stand_by(&self, incarnation: u64) {
        if let Some(actor) = self.actors.lock().get_mut(&incarnation) {
            actor.standing_by = true;
        }
    }

    /// Sets the index of an actor, unless it had a smaller one before.
    pub(super) fn set_index(&self, incarnation: u64, index: u64) {
        if let Some(actor) = self.actors.lock().get_mut(&incarnation) {
            actor.order = actor.order.min(index);
        }
    }

    /// Whether a newer process of the same name took the place of this one.
    pub(super) fn is_superseded(&self, incarnation: u64) -> bool {
        self.actors.lock().get(&incarnation).is_some_and(|actor| actor.superseded)
    }

    /// Whether an actor is present, or left so lately that it may come back.
    pub(super) fn expects(&self, incarnation: u64, now: Instant) -> bool {
        let lately = |gone: Instant| now.duration_since(gone) < GRACE;
        self.actors
            .lock()
            .get(&incarnation)
            .is_some_and(|actor| actor.is_present(now) || (!actor.superseded && actor.gone.is_some_and(lately)))
    }

    /// Notes that an actor sent something. It is then present, even if its stream of parameters ended. False if it is
    /// superseded.
    pub(super) fn heard(&self, incarnation: u64, now: Instant) -> bool {
        let mut actors = self.actors.lock();
        let Some(actor) = actors.get_mut(&incarnation) else { return true };
        (actor.heard, actor.gone) = (now, None);
        !actor.superseded
    }

    /// Counts a stream of parameters until the returned value is dropped. `None` if the actor has not joined.
    pub(super) fn open_stream(self: &Arc<Self>, incarnation: u64) -> Option<Presence> {
        let mut actors = self.actors.lock();
        let actor = actors.get_mut(&incarnation).filter(|actor| !actor.standing_by)?;
        (actor.streams, actor.opened, actor.gone) = (actor.streams + 1, Some(Instant::now()), None);
        Some(Presence { roster: self.clone(), incarnation, kind: Kind::Stream })
    }

    /// Counts an unroll that waits for a place in a batch, until the returned value is dropped.
    pub(super) fn begin_waiting(self: &Arc<Self>, incarnation: u64) -> Presence {
        if let Some(actor) = self.actors.lock().get_mut(&incarnation) {
            actor.waiting += 1;
        }
        Presence { roster: self.clone(), incarnation, kind: Kind::Waiting }
    }

    /// The actors that were here lately and have no stream of parameters now.
    pub(super) fn absent(self: &Arc<Self>, now: Instant) -> Absent {
        let lately = |actor: &Actor| now.duration_since(actor.gone.unwrap_or(actor.heard)) < GRACE;
        let is_absent = |actor: &Actor| actor.streams == 0 && !actor.superseded && !actor.standing_by && lately(actor);
        let actors = self.actors.lock();
        let incarnations = actors.iter().filter(|(_, actor)| is_absent(actor)).map(|(incarnation, _)| *incarnation);
        Absent { roster: Arc::clone(self), since: now, incarnations: incarnations.collect() }
    }

    /// Counts the actors by their state.
    pub(super) fn census(&self, now: Instant) -> Census {
        let mut census = Census::default();
        for actor in self.actors.lock().values().filter(|actor| actor.is_remembered(now) && !actor.standing_by) {
            census.waiting += u64::from(actor.waiting);
            *match (actor.is_present(now), actor.is_slow(now)) {
                (false, _) => &mut census.lost,
                (true, true) => &mut census.slow,
                (true, false) => &mut census.alive,
            } += 1;
        }
        census
    }
}

/// Actors that had no stream of parameters at some moment.
#[derive(Debug)]
pub struct Absent {
    roster: Arc<Roster>,
    since: Instant,
    incarnations: Vec<u64>,
}

impl Absent {
    /// Whether one of them has opened no stream since then.
    pub fn remain(&mut self) -> bool {
        let actors = self.roster.actors.lock();
        let returned = |actor: &Actor| actor.opened.is_some_and(|opened| opened > self.since);
        self.incarnations.retain(|incarnation| !actors.get(incarnation).is_none_or(returned));
        !self.incarnations.is_empty()
    }
}

/// A stream or an unroll of an actor, which is counted until this is dropped.
#[derive(Debug)]
pub(super) struct Presence {
    roster: Arc<Roster>,
    incarnation: u64,
    kind: Kind,
}

/// What a [`Presence`] counts.
#[derive(Clone, Copy, Debug)]
enum Kind {
    Stream,
    Waiting,
}

impl Drop for Presence {
    fn drop(&mut self) {
        // If the actor joined only after this began, this was not counted.
        match (self.roster.actors.lock().get_mut(&self.incarnation), self.kind) {
            (Some(actor), Kind::Waiting) => actor.waiting = actor.waiting.saturating_sub(1),
            (Some(actor), Kind::Stream) => {
                actor.streams = actor.streams.saturating_sub(1);
                if actor.streams == 0 {
                    actor.gone = Some(Instant::now());
                }
            }
            (None, _) => {}
        }
    }
}

/// The status for an actor whose place another process took.
pub(super) fn superseded() -> Status {
    Status::aborted("a newer process of the same name took this one's place")
}

#[cfg(test)]
mod tests;
