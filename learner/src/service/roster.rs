//! Which actors are there, and how they are.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use super::lock;

/// An actor that joined has so long to open its streams, and one whose connection ended to come back before its
/// environments of a run in lockstep are given away.
const JOINING: Duration = Duration::from_secs(30);
/// Silence after which an actor that the learner waits for is slow.
const SLOW: Duration = Duration::from_secs(60);
/// How long a lost actor is spoken of.
const REMEMBERED: Duration = Duration::from_secs(600);
/// Lost actors spoken of at most.
const LOST: usize = 65_536;

/// Actors by how they are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Census {
    /// Connected, and heard of lately or waiting for the learner.
    pub(crate) alive: u64,
    /// Connected, and silent although the learner waits.
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

/// Whether an actor may come in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Admission {
    Welcome,
    /// There are too many.
    Full,
    /// A newer process of its name took its place.
    Superseded,
}

#[derive(Clone, Debug)]
struct Actor {
    /// Who it is over its restarts; empty is nobody.
    name: String,
    /// Processes of a name take each other's place in this order: of their indices, and before it has one a process is the
    /// newest.
    order: u64,
    /// A newer process of its name came.
    superseded: bool,
    /// It came in and found nothing to do: it comes again, and is nobody until then.
    standing_by: bool,
    /// Streams of parameters that are open.
    streams: u32,
    /// Unrolls of it that wait for a place in a batch.
    waiting: u32,
    heard: Instant,
    /// When its last stream ended, if that is all that is known of it.
    gone: Option<Instant>,
}

impl Actor {
    fn is_present(&self, now: Instant) -> bool {
        let lately = self.gone.is_none() && now.duration_since(self.heard) < JOINING;
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

    /// Lets an actor in, in the place of an older one of its name, or says why not; one that is in already always stays. Who
    /// comes back says which index it had: after a restart of the learner that is all that tells the older from the newer.
    pub(super) fn join(&self, incarnation: u64, name: &str, had: Option<u64>, now: Instant) -> Admission {
        let mut actors = lock(&self.actors);
        match actors.get_mut(&incarnation) {
            Some(actor) if actor.superseded => return Admission::Superseded,
            Some(actor) if actor.is_present(now) => {
                actor.heard = now;
                return Admission::Welcome;
            }
            _ => {}
        }
        let order = had.unwrap_or(u64::MAX);
        let namesake = |other: u64, actor: &Actor| other != incarnation && !name.is_empty() && actor.name == name;
        let mut namesakes = actors.iter().filter(|(other, actor)| namesake(**other, actor));
        if namesakes.any(|(_, actor)| actor.order > order && !actor.superseded) {
            return Admission::Superseded;
        }
        let older = |other: u64, actor: &Actor| namesake(other, actor) && actor.order <= order;
        let rivals = actors.iter().filter(|(other, actor)| actor.is_present(now) && !older(**other, actor));
        if rivals.count() >= self.limit {
            return Admission::Full;
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
        if actors.len() >= LOST {
            actors.retain(|_, actor| actor.streams > 0 || actor.is_present(now));
        } else {
            actors.retain(|_, actor| actor.is_remembered(now));
        }
        let name = name.to_owned();
        let actor = Actor {
            name,
            order,
            superseded: false,
            standing_by: false,
            streams: 0,
            waiting: 0,
            heard: now,
            gone: None,
        };
        let actor = actors.entry(incarnation).or_insert(actor);
        (actor.heard, actor.gone, actor.standing_by) = (now, None, false);
        Admission::Welcome
    }

    /// Notes that an actor that came in finds nothing to do. It keeps its place among the processes of its name alone.
    pub(super) fn turn_away(&self, incarnation: u64) {
        if let Some(actor) = lock(&self.actors).get_mut(&incarnation) {
            actor.standing_by = true;
        }
    }

    /// Notes the index that an actor got, unless it had one before.
    pub(super) fn number(&self, incarnation: u64, index: u64) {
        if let Some(actor) = lock(&self.actors).get_mut(&incarnation) {
            actor.order = actor.order.min(index);
        }
    }

    /// Whether a newer process of its name took its place.
    pub(super) fn is_superseded(&self, incarnation: u64) -> bool {
        lock(&self.actors).get(&incarnation).is_some_and(|actor| actor.superseded)
    }

    /// Whether an actor is there, or went so lately that it may be on its way back.
    pub(super) fn expects(&self, incarnation: u64, now: Instant) -> bool {
        let lately = |gone: Instant| now.duration_since(gone) < JOINING;
        lock(&self.actors)
            .get(&incarnation)
            .is_some_and(|actor| actor.is_present(now) || (!actor.superseded && actor.gone.is_some_and(lately)))
    }

    /// Notes that something came from an actor, which is there then, whatever became of its stream of parameters. False if it
    /// is superseded.
    pub(super) fn heard(&self, incarnation: u64, now: Instant) -> bool {
        let mut actors = lock(&self.actors);
        let Some(actor) = actors.get_mut(&incarnation) else { return true };
        (actor.heard, actor.gone) = (now, None);
        !actor.superseded
    }

    /// Notes a stream of parameters, until what is returned is dropped. `None` of an actor that has not joined.
    pub(super) fn watch(self: &Arc<Self>, incarnation: u64) -> Option<Presence> {
        let mut actors = lock(&self.actors);
        let actor = actors.get_mut(&incarnation).filter(|actor| !actor.standing_by)?;
        (actor.streams, actor.gone) = (actor.streams + 1, None);
        Some(Presence { roster: self.clone(), incarnation, kind: Kind::Stream })
    }

    /// Notes an unroll that waits for a place, until what is returned is dropped.
    pub(super) fn wait(self: &Arc<Self>, incarnation: u64) -> Presence {
        if let Some(actor) = lock(&self.actors).get_mut(&incarnation) {
            actor.waiting += 1;
        }
        Presence { roster: self.clone(), incarnation, kind: Kind::Waiting }
    }

    pub(super) fn census(&self, now: Instant) -> Census {
        let mut census = Census::default();
        for actor in lock(&self.actors).values().filter(|actor| actor.is_remembered(now) && !actor.standing_by) {
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

/// Something of an actor that is counted while it lasts.
#[derive(Debug)]
pub(super) struct Presence {
    roster: Arc<Roster>,
    incarnation: u64,
    kind: Kind,
}

/// What is counted of an actor.
#[derive(Clone, Copy, Debug)]
enum Kind {
    Stream,
    Waiting,
}

impl Drop for Presence {
    fn drop(&mut self) {
        // It may have joined only after this began: then this was not counted.
        match (lock(&self.roster.actors).get_mut(&self.incarnation), self.kind) {
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

#[cfg(test)]
mod tests {
    use super::*;

    fn census(roster: &Roster, now: Instant) -> (u64, u64, u64, u64) {
        let Census { alive, slow, lost, waiting } = roster.census(now);
        (alive, slow, lost, waiting)
    }

    fn joins(roster: &Roster, incarnation: u64, now: Instant) -> bool {
        roster.join(incarnation, "", None, now) == Admission::Welcome
    }

    #[test]
    fn actors_are_alive_then_slow_then_lost_then_forgotten() {
        let (roster, start) = (Arc::new(Roster::new(10)), Instant::now());
        assert!(joins(&roster, 1, start));
        assert_eq!(census(&roster, start), (1, 0, 0, 0));
        let watching = roster.watch(1);
        assert_eq!(census(&roster, start + SLOW), (0, 1, 0, 0));
        let waiting = roster.wait(1);
        assert_eq!(census(&roster, start + SLOW), (1, 0, 0, 1), "it waits for the learner, not the learner for it");
        drop(waiting);
        roster.heard(1, start + SLOW);
        assert_eq!(census(&roster, start + SLOW), (1, 0, 0, 0));
        drop(watching);
        assert_eq!(census(&roster, Instant::now()), (0, 0, 1, 0));
        assert_eq!(census(&roster, Instant::now() + REMEMBERED), (0, 0, 0, 0));
    }

    #[test]
    fn the_limit_counts_those_who_are_there_and_never_those_who_come_back() {
        let (roster, start) = (Arc::new(Roster::new(2)), Instant::now());
        assert!(joins(&roster, 1, start) && joins(&roster, 2, start));
        assert!(!joins(&roster, 3, start));
        assert!(joins(&roster, 1, start), "a reconnection");
        assert!(joins(&roster, 3, start + JOINING), "who joins and opens no stream gives up the place");
    }

    #[test]
    fn a_newer_process_of_a_name_takes_the_older_ones_place_for_ever() {
        let (roster, start) = (Arc::new(Roster::new(2)), Instant::now());
        assert_eq!(roster.join(1, "pod-0", None, start), Admission::Welcome);
        assert_eq!(roster.join(2, "pod-1", None, start), Admission::Welcome);
        let _watching = roster.watch(1);
        assert_eq!(roster.join(3, "pod-2", None, start), Admission::Full);
        assert_eq!(roster.join(4, "pod-0", None, start), Admission::Welcome, "there is one less");
        assert!(!roster.heard(1, start) && roster.heard(4, start));
        roster.number(4, 4);
        assert!(roster.is_superseded(1) && !roster.is_superseded(2) && !roster.is_superseded(4));
        assert!(!roster.expects(1, start) && roster.expects(4, start));
        assert_eq!(roster.join(1, "pod-0", None, start), Admission::Superseded);
        assert_eq!(roster.join(4, "pod-0", None, start), Admission::Welcome, "a reconnection");
        assert_eq!(roster.join(2, "pod-1", None, start), Admission::Welcome);
    }

    #[test]
    fn which_process_of_a_name_is_the_newer_is_known_after_everything_else_was_forgotten() {
        let later = Instant::now() + REMEMBERED * 2;
        for order in [[(1, 3), (2, 7)], [(2, 7), (1, 3)]] {
            let roster = Roster::new(2);
            let joined = order.map(|(incarnation, had)| roster.join(incarnation, "pod-0", Some(had), later));
            assert_eq!(joined[0], Admission::Welcome);
            assert_eq!(roster.is_superseded(1), order[0].0 == 1, "the older one goes");
            assert_eq!(joined[1], if order[1].0 == 2 { Admission::Welcome } else { Admission::Superseded });
            assert!(!roster.is_superseded(2) && roster.heard(2, later));
        }
    }

    #[test]
    fn who_has_no_name_is_in_nobodys_place() {
        let (roster, start) = (Roster::new(2), Instant::now());
        assert!(joins(&roster, 1, start) && joins(&roster, 2, start));
        assert!(roster.heard(1, start) && roster.heard(2, start));
    }

    #[test]
    fn who_sends_is_there_although_it_reads_no_parameters_any_more() {
        let (roster, start) = (Arc::new(Roster::new(1)), Instant::now());
        assert!(joins(&roster, 1, start));
        drop(roster.watch(1));
        let later = Instant::now();
        roster.heard(1, later);
        assert_eq!(roster.join(2, "", None, later), Admission::Full);
    }

    #[test]
    fn an_actor_is_expected_while_it_is_there_and_a_little_longer() {
        let (roster, start) = (Arc::new(Roster::new(10)), Instant::now());
        assert!(!roster.expects(1, start));
        assert!(joins(&roster, 1, start) && roster.expects(1, start));
        let watching = roster.watch(1);
        assert!(roster.expects(1, start + JOINING * 2));
        drop(watching);
        let gone = Instant::now();
        assert!(roster.expects(1, gone) && !roster.expects(1, gone + JOINING));
    }

    #[test]
    fn who_stands_by_is_not_there_and_gives_way_to_a_newer_process_of_its_name() {
        let (roster, start) = (Arc::new(Roster::new(1)), Instant::now());
        let join = |incarnation| roster.join(incarnation, "comic-actor-0", None, start);
        assert_eq!(join(1), Admission::Welcome);
        roster.turn_away(1);
        assert_eq!(census(&roster, start), (0, 0, 0, 0));
        assert!(roster.watch(1).is_none() && !roster.expects(1, start));
        assert!(joins(&roster, 2, start), "it takes nobody's place");
        roster.turn_away(2);
        assert_eq!(join(1), Admission::Welcome, "it comes again");
        roster.turn_away(1);
        assert_eq!(join(3), Admission::Welcome);
        assert_eq!(join(1), Admission::Superseded);
        assert!(roster.watch(3).is_some());
    }

    #[test]
    fn who_has_not_joined_is_not_counted_and_memory_is_bounded() {
        let roster = Arc::new(Roster::new(10));
        drop((roster.watch(7), roster.wait(7)));
        assert_eq!(lock(&roster.actors).len(), 0);
        let start = Instant::now();
        for incarnation in 0..100 {
            assert!(joins(&roster, incarnation, start + (JOINING + REMEMBERED) * incarnation as u32));
        }
        assert!(lock(&roster.actors).len() < 3);
    }
}
