//! The events of actors, links and learners.

use std::collections::VecDeque;

use rand::rngs::StdRng;
use rand::{Rng as _, SeedableRng as _};

use super::agenda::Agenda;
use super::batcher::{Batcher, Unroll};
use super::link::{Direction, Key, Link};
use super::observed::{Dropped, Observed};
use super::publisher::{Begun, Publisher};
use super::settings::Settings;

/// Seconds after which a reader without a place looks for one again (`Holding::idle`).
const RETRY: f64 = 5.0;
/// The part of the measured time and of the measured versions that passes before: what the start has left must end.
const WARM_UP: f64 = 0.25;

#[derive(Debug)]
pub(super) struct Simulation {
    settings: Settings,
    random: StdRng,
    now: f64,
    events: Agenda<Event>,
    links: Vec<Link<Transfer>>,
    learners: Vec<Learner>,
    actors: Vec<Actor>,
    workers: Vec<Worker>,
    updates: u64,
    version: u64,
    /// When the update began that is under way.
    updating: Option<f64>,
    observed: Observed,
}

#[derive(Clone, Copy, Debug)]
enum Event {
    /// An actor connects.
    Join(usize),
    /// A worker has made an unroll of each of its environments.
    Round(usize),
    /// The learners have finished an update.
    Updated,
    /// Readers of this learner look for a version again.
    Retry(usize),
}

/// What a link carries; each names the actor.
#[derive(Clone, Copy, Debug)]
enum Transfer {
    Assets(usize),
    Version(usize),
    Unroll(usize),
}

#[derive(Debug)]
struct Learner {
    batcher: Batcher,
    publisher: Publisher,
    /// The versions of the unrolls in the batch that the learner has taken.
    batch: Option<Vec<u64>>,
    /// Actors that read no version at present.
    idle: Vec<usize>,
    retries: bool,
    /// Unrolls that have arrived and are not read yet.
    unread: usize,
}

#[derive(Debug, Default)]
struct Actor {
    /// The version that it has; 0 before the first.
    version: u64,
    /// The newest version that an acknowledgement has named.
    announced: u64,
    reading: Option<(u64, Key)>,
    /// Unrolls that are not sent yet: at most one for each environment.
    outbox: VecDeque<Unroll>,
    uploading: Option<Unroll>,
    /// An unroll that has arrived and is not read yet: the window of the stream has room for one.
    unread: Option<Unroll>,
    /// Whether an unroll of this stream waits for its place in a batch.
    inserting: bool,
    /// Workers that wait for a version.
    parked: Vec<usize>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Worker {
    version: u64,
    /// Unrolls without an acknowledgement.
    unacknowledged: usize,
    /// How long its present round takes.
    round: f64,
    /// Since when it waits: for acknowledgements, and then for a version.
    since: f64,
}

impl Simulation {
    pub(super) fn new(settings: Settings) -> Self {
        let Settings { actors, threads, learners, batch, ahead, seed, .. } = settings;
        let learner = || Learner {
            batcher: Batcher::new(batch / learners, ahead, settings.max_versions_late()),
            publisher: Publisher::default(),
            batch: None,
            idle: Vec::new(),
            retries: false,
            unread: 0,
        };
        let actor = |index: usize| Actor { parked: (index * threads..).take(threads).collect(), ..Actor::default() };
        let links = learners * if settings.shared_link { 1 } else { 2 };
        let mut simulation = Self {
            settings,
            random: StdRng::seed_from_u64(seed),
            now: 0.0,
            events: Agenda::new(),
            links: (0..links).map(|_| Link::new(settings.bytes_per_second())).collect(),
            learners: (0..learners).map(|_| learner()).collect(),
            actors: (0..actors).map(actor).collect(),
            workers: vec![Worker::default(); settings.workers()],
            updates: 0,
            version: 0,
            updating: None,
            observed: Observed::new(actors),
        };
        simulation.publish();
        for actor in 0..actors {
            let at = settings.start_s * simulation.random.random::<f64>();
            simulation.events.add(at, Event::Join(actor));
        }
        simulation
    }

    /// Until the last actor acts, then a while, then the time that is measured, and then until the last actor has the last
    /// version of that time.
    pub(super) fn run(mut self) -> Observed {
        let Settings { seconds, versions, give_up_s, .. } = self.settings;
        while self.observed.start().is_none() && self.step(give_up_s) {}
        self.pass(seconds * WARM_UP, (versions as f64 * WARM_UP).ceil() as u64);
        let dropped = self.dropped_in_batches();
        let carried = self.carried();
        self.observed.begin(self.now);
        self.pass(seconds, versions);
        let [bytes_in, bytes_out] = self.carried();
        self.observed.bytes = [bytes_in - carried[0], bytes_out - carried[1]];
        self.observed.dropped.in_a_batch = self.dropped_in_batches() - dropped;
        if let Some(since) = self.updating {
            self.observed.learned(since, self.now);
        }
        self.observed.end(self.now);
        let limit = self.now + give_up_s;
        while self.observed.awaits_a_version() && self.step(limit) {}
        self.observed
    }

    /// Lets this time pass, and more until this many versions are published, unless one needs too long.
    fn pass(&mut self, seconds: f64, versions: u64) {
        let (end, last) = (self.now + seconds, self.version + versions);
        while self.step(end) {}
        for newer in self.version + 1..=last {
            let limit = self.now + self.settings.give_up_s;
            while self.version < newer && self.step(limit) {}
            if self.version < newer {
                return;
            }
        }
    }

    /// The next event, if there is one until `limit`.
    fn step(&mut self, limit: f64) -> bool {
        let scheduled = self.events.first().map_or(f64::INFINITY, |(at, _)| at);
        let ends = self.links.iter_mut().enumerate().filter_map(|(link, all)| Some((all.next_end()?, link)));
        let (end, link) = ends.min_by(|one, other| one.0.total_cmp(&other.0)).unwrap_or((f64::INFINITY, 0));
        if scheduled.min(end) > limit {
            self.now = limit;
            return false;
        }
        if scheduled <= end {
            let Some((at, event)) = self.events.take_first() else { return false };
            self.now = at;
            self.handle(event);
        } else {
            self.now = end;
            match self.links[link].end_next(end) {
                Some(Transfer::Assets(actor)) => self.read(actor),
                Some(Transfer::Version(actor)) => self.received(actor),
                Some(Transfer::Unroll(actor)) => self.arrived(actor),
                None => {}
            }
        }
        true
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::Join(actor) if self.settings.asset_bytes > 0.0 => {
                self.transfer(Transfer::Assets(actor), actor, self.settings.asset_bytes, Direction::Out);
            }
            Event::Join(actor) => self.read(actor),
            Event::Round(worker) => self.finish_round(worker),
            Event::Updated => self.updated(),
            Event::Retry(learner) => {
                self.learners[learner].retries = false;
                self.wake(learner);
            }
        }
    }

    // Parameters to the actors.

    /// Lets an actor that reads nothing begin a version, and those that lose theirs to it begin another one.
    fn read(&mut self, actor: usize) {
        let learner = self.learner_of(actor);
        let mut readers = VecDeque::from([actor]);
        while let Some(reader) = readers.pop_front() {
            let (begun, replaced) = self.learners[learner].publisher.begin(self.actors[reader].version, self.now);
            match begun {
                Begun::Reading(version) => {
                    let bytes = self.settings.parameter_bytes;
                    let key = self.transfer(Transfer::Version(reader), reader, bytes, Direction::Out);
                    self.actors[reader].reading = Some((version, key));
                }
                Begun::NothingNew => self.learners[learner].idle.push(reader),
                Begun::AllPlacesTaken => {
                    self.learners[learner].idle.push(reader);
                    if !std::mem::replace(&mut self.learners[learner].retries, true) {
                        self.events.add(self.now + RETRY, Event::Retry(learner));
                    }
                }
            }
            let held = self.learners[learner].publisher.in_memory();
            self.observed.held(held);
            if let Some(replaced) = replaced {
                readers.extend(self.cut_off(learner, replaced));
            }
        }
    }

    /// The actors that were reading this version, whose transfers end.
    fn cut_off(&mut self, learner: usize, replaced: u64) -> Vec<usize> {
        let link = self.link(learner, Direction::Out);
        let mut lost = Vec::new();
        for actor in (learner..self.actors.len()).step_by(self.learners.len()) {
            if let Some((_, key)) = self.actors[actor].reading.take_if(|(version, _)| *version == replaced) {
                self.links[link].cancel(self.now, key);
                lost.push(actor);
            }
        }
        self.observed.cut_off(lost.len());
        lost
    }

    fn received(&mut self, actor: usize) {
        let Some((version, _)) = self.actors[actor].reading.take() else { return };
        let before = std::mem::replace(&mut self.actors[actor].version, version);
        self.observed.received(self.now, before, version);
        for worker in std::mem::take(&mut self.actors[actor].parked) {
            self.begin_round(worker);
        }
        let learner = self.learner_of(actor);
        let has_place = self.learners[learner].publisher.finish(version);
        self.read(actor);
        if has_place {
            self.wake(learner);
        }
    }

    /// Lets the actors that read nothing look for a version.
    fn wake(&mut self, learner: usize) {
        std::mem::take(&mut self.learners[learner].idle).into_iter().for_each(|actor| self.read(actor));
    }

    fn publish(&mut self) {
        self.version += 1;
        self.observed.published(self.now);
        for learner in 0..self.learners.len() {
            self.learners[learner].batcher.set_version(self.version);
            self.learners[learner].publisher.publish(self.version);
            self.wake(learner);
        }
    }

    // Unrolls to the learners.

    /// Begins unrolls with the actor's version, unless it is older than one that an acknowledgement has named.
    fn begin_round(&mut self, worker: usize) {
        let owner = worker / self.settings.threads;
        let Actor { version, announced, ref mut parked, .. } = self.actors[owner];
        if version == 0 || (version < announced && !self.settings.any_version) {
            parked.push(worker);
            return;
        }
        let round = self.settings.round() * self.about_one();
        let first = self.workers[worker].version == 0;
        self.observed.began(self.now, first.then_some(owner), self.now - self.workers[worker].since);
        self.workers[worker] = Worker { version, round, ..self.workers[worker] };
        self.events.add(self.now + round, Event::Round(worker));
    }

    fn finish_round(&mut self, worker: usize) {
        let (owner, environments) = (worker / self.settings.threads, self.settings.environments);
        let Worker { version, round, .. } = self.workers[worker];
        self.observed.acted(round);
        self.workers[worker] = Worker { unacknowledged: environments, since: self.now, ..self.workers[worker] };
        self.actors[owner].outbox.extend(std::iter::repeat_n(Unroll { worker, version }, environments));
        self.upload(owner);
    }

    /// Sends the next unroll, if the last one was read.
    fn upload(&mut self, actor: usize) {
        let Actor { outbox, uploading, unread, .. } = &mut self.actors[actor];
        if uploading.is_some() || unread.is_some() {
            return;
        }
        *uploading = outbox.pop_front();
        if uploading.is_some() {
            self.transfer(Transfer::Unroll(actor), actor, self.settings.unroll_bytes, Direction::In);
        }
    }

    fn arrived(&mut self, actor: usize) {
        let learner = self.learner_of(actor);
        self.actors[actor].unread = self.actors[actor].uploading.take();
        self.learners[learner].unread += 1;
        self.take_unread(actor);
        self.pump(learner);
    }

    /// The learner reads an unroll when the one before it has its place.
    fn take_unread(&mut self, actor: usize) {
        let Learner { batcher, unread, .. } = &mut self.learners[actor % self.settings.learners];
        while !self.actors[actor].inserting
            && let Some(unroll) = self.actors[actor].unread.take()
        {
            *unread -= 1;
            match batcher.is_stale(unroll.version) {
                true => {
                    self.observed.drop(Dropped { arriving: 1, ..Dropped::default() });
                    self.acknowledge(actor, unroll.worker);
                    break;
                }
                false => {
                    batcher.enqueue(unroll);
                    self.actors[actor].inserting = true;
                }
            }
        }
        self.upload(actor);
    }

    /// Moves unrolls into batches and batches to the learner, as long as there are any.
    fn pump(&mut self, learner: usize) {
        loop {
            while let Some((unroll, taken)) = self.learners[learner].batcher.admit() {
                if !taken {
                    self.observed.drop(Dropped { waiting: 1, ..Dropped::default() });
                }
                let owner = unroll.worker / self.settings.threads;
                self.actors[owner].inserting = false;
                self.acknowledge(owner, unroll.worker);
                self.take_unread(owner);
            }
            let Learner { batcher, batch, unread, .. } = &mut self.learners[learner];
            self.observed.waiting(batcher.waiting() + *unread);
            if batch.is_some() {
                return;
            }
            let dropped = batcher.dropped();
            *batch = batcher.take();
            if batch.is_none() && batcher.dropped() == dropped {
                return;
            }
            // Slots are free again.
            self.update();
        }
    }

    fn acknowledge(&mut self, actor: usize, worker: usize) {
        self.actors[actor].announced = self.version;
        self.workers[worker].unacknowledged -= 1;
        if self.workers[worker].unacknowledged == 0 {
            self.observed.acknowledged(self.now - self.workers[worker].since);
            self.workers[worker].since = self.now;
            self.begin_round(worker);
        }
    }

    // Updates.

    /// Begins an update when every learner has its batch.
    fn update(&mut self) {
        if self.learners.iter().any(|learner| learner.batch.is_none()) {
            return;
        }
        let slowest = (0..self.learners.len()).map(|_| self.about_one()).fold(0.0, f64::max);
        self.updating = Some(self.now);
        self.events.add(self.now + self.settings.compute() * slowest + self.settings.exchanges(), Event::Updated);
    }

    fn updated(&mut self) {
        if let Some(since) = self.updating.take() {
            self.observed.learned(since, self.now);
        }
        self.updates += 1;
        for learner in &mut self.learners {
            let versions = learner.batch.take().unwrap_or_default();
            self.observed.trained(versions.iter().map(|version| self.version - version));
        }
        // Before the memory of the batches is free: workers that wait for it then continue with this version.
        if self.updates.is_multiple_of(self.settings.target_period) {
            self.publish();
        }
        self.learners.iter_mut().for_each(|learner| learner.batcher.trained());
        (0..self.learners.len()).for_each(|learner| self.pump(learner));
    }

    // What all of these need.

    fn learner_of(&self, actor: usize) -> usize {
        actor % self.learners.len()
    }

    fn link(&self, learner: usize, direction: Direction) -> usize {
        match self.settings.shared_link {
            true => learner,
            false => 2 * learner + direction as usize,
        }
    }

    fn transfer(&mut self, what: Transfer, actor: usize, bytes: f64, direction: Direction) -> Key {
        let (link, weight) = (self.link(self.learner_of(actor), direction), self.about_one());
        self.links[link].start(self.now, what, bytes, weight, direction)
    }

    /// A number between 1 - `spread` and 1 + `spread`.
    fn about_one(&mut self) -> f64 {
        1.0 + self.settings.spread * (2.0 * self.random.random::<f64>() - 1.0)
    }

    fn dropped_in_batches(&self) -> u64 {
        self.learners.iter().map(|learner| learner.batcher.dropped()).sum()
    }

    /// Bytes that the links have carried so far, in and out.
    fn carried(&mut self) -> [f64; 2] {
        let Self { now, links, .. } = self;
        [Direction::In, Direction::Out]
            .map(|direction| links.iter_mut().map(|link| link.delivered(*now, direction)).sum())
    }
}
