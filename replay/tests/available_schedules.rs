//! Whatever the order of inserts, cancellations, partial batches and drops: unrolls leave in the order in which they
//! came, all are accounted for, and no slot is lost.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::collections::{HashSet, VecDeque};
use std::future::Future;
use std::pin::Pin;

use comic_proto::v1::UnrollHeader;
use comic_replay::{Batch, BatchOrder, Batcher, Config, Ledger, Next, Outcome, Phase};
use common::{Actor, PHASE, available_now, batch_now, layout, now, payload};
use proptest::prelude::*;

const ACTORS: u64 = 3;
const UNROLLS: usize = 4;
const MAX_STALENESS: u64 = 3;

#[derive(Clone, Copy, Debug)]
enum Event {
    Send { actor: u64 },
    Cancel { which: usize },
    TakeAvailable { at_most: usize },
    TakeFull,
    Train,
    DropBatch,
    NewVersion,
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        16 => (0..ACTORS).prop_map(|actor| Event::Send { actor }),
        2 => (0..9_usize).prop_map(|which| Event::Cancel { which }),
        4 => (0..7_usize).prop_map(|at_most| Event::TakeAvailable { at_most }),
        1 => Just(Event::TakeFull),
        4 => Just(Event::Train),
        1 => Just(Event::DropBatch),
        2 => Just(Event::NewVersion),
    ]
}

/// Actor and sequence number of an unroll.
type Name = (u64, u64);

fn name(header: &UnrollHeader) -> Name {
    (header.actor, header.sequence)
}

type Insert = Pin<Box<dyn Future<Output = Outcome>>>;

struct World {
    batcher: Batcher,
    phase: Phase,
    actors: Vec<Actor>,
    sequences: Vec<u64>,
    /// Inserts that wait for a slot, in the order in which they began.
    inserts: Vec<(UnrollHeader, Insert)>,
    /// What should wait in the batcher, the oldest first, and its versions.
    waiting: VecDeque<(Name, u64)>,
    held: Vec<Batch>,
    ended: HashSet<Name>,
    stale: u64,
    slots: usize,
}

impl World {
    fn new(ahead: usize) -> Self {
        let config = Config { unrolls: UNROLLS, max_staleness: MAX_STALENESS, ahead, order: BatchOrder::Arrival };
        let batcher = Batcher::new(layout(), config, PHASE, Ledger::new());
        Self {
            phase: PHASE,
            actors: (0..ACTORS).map(|incarnation| Actor::join(&batcher, incarnation)).collect(),
            sequences: vec![0; ACTORS as usize],
            inserts: Vec::new(),
            waiting: VecDeque::new(),
            held: Vec::new(),
            ended: HashSet::new(),
            stale: 0,
            slots: UNROLLS * (ahead + 1).min(2),
            batcher,
        }
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Send { actor } => {
                let sequence = &mut self.sequences[actor as usize];
                let header = UnrollHeader {
                    version: self.phase.version,
                    ..self.actors[actor as usize].header(std::mem::replace(sequence, *sequence + 1))
                };
                let (batcher, sent) = (self.batcher.clone(), header.clone());
                let insert = Box::pin(async move { batcher.insert(&sent, payload(&sent)).await });
                self.inserts.push((header, insert));
            }
            Event::Cancel { which } => {
                if which < self.inserts.len() {
                    drop(self.inserts.remove(which));
                }
            }
            Event::TakeAvailable { at_most } => self.take_available(at_most),
            Event::TakeFull => {
                let batch = batch_now(&self.batcher);
                self.drop_stale(false);
                self.receive(batch, false);
            }
            Event::Train => {
                if let Some(batch) = self.held.pop() {
                    self.batcher.trained(batch);
                }
            }
            Event::DropBatch => drop(self.held.pop()),
            Event::NewVersion => {
                self.phase.version += 1;
                self.batcher.set_phase(self.phase);
            }
        }
        self.poll();
    }

    fn take_available(&mut self, at_most: usize) {
        let batch = available_now(&self.batcher, at_most);
        self.drop_stale(true);
        let found = batch.as_ref().map_or(0, |batch| batch.unrolls);
        let expected = at_most.min(self.waiting.len()).min(UNROLLS);
        assert!(found == expected || found == 0 && !self.held.is_empty(), "{found} instead of {expected}");
        self.receive(batch, true);
    }

    /// Follows what the batcher dropped as stale: nothing, or all that is stale.
    fn drop_stale(&mut self, surely: bool) {
        let dropped = self.batcher.accounting().dropped.stale - self.stale;
        self.stale += dropped;
        if surely || dropped > 0 {
            let (before, version) = (self.waiting.len(), self.phase.version);
            self.waiting.retain(|(_, made)| version - made <= MAX_STALENESS);
            assert_eq!((before - self.waiting.len()) as u64, dropped);
        }
    }

    /// Checks that a batch has the oldest unrolls.
    fn receive(&mut self, batch: Option<Batch>, in_order: bool) {
        let Some(batch) = batch else { return };
        let mut found: Vec<_> = batch.headers().iter().map(name).collect();
        let mut oldest: Vec<_> = self.waiting.drain(..found.len()).map(|(name, _)| name).collect();
        if !in_order {
            found.sort_unstable();
            oldest.sort_unstable();
        }
        assert_eq!(found, oldest);
        assert!(found.into_iter().all(|name| self.ended.insert(name)), "given twice");
        self.held.push(batch);
    }

    /// Polls every insert, in the order in which they began.
    fn poll(&mut self) {
        for (header, mut insert) in std::mem::take(&mut self.inserts) {
            match now(&mut insert) {
                None => self.inserts.push((header, insert)),
                Some(Outcome::Taken) => self.waiting.push_back((name(&header), header.version)),
                Some(Outcome::Stale) => self.stale += 1,
                Some(other) => panic!("{other:?}"),
            }
        }
    }

    fn check(&self) {
        let accounting = self.batcher.accounting();
        assert!(accounting.balance(), "{accounting:?}");
        let held: usize = self.held.iter().map(|batch| batch.unrolls).sum();
        assert_eq!(accounting.in_flight, (self.waiting.len() + held) as u64);
        assert_eq!(accounting.dropped.stale, self.stale);
        assert!(self.waiting.len() <= self.slots, "more than the memory");
    }

    /// Takes everything, and checks that all inserts end and every slot is free again.
    fn finish(mut self) {
        self.held.drain(..).for_each(|batch| self.batcher.trained(batch));
        self.poll();
        while !self.waiting.is_empty() {
            self.take_available(3);
            self.held.drain(..).for_each(|batch| self.batcher.trained(batch));
            self.poll();
        }
        assert!(self.inserts.is_empty(), "an insert waits though nothing is there");
        for sent in 0..self.slots {
            self.happen(Event::Send { actor: sent as u64 % ACTORS });
        }
        assert_eq!((self.waiting.len(), self.inserts.len()), (self.slots, 0), "a slot was lost");
        self.check();
        self.batcher.close();
        assert!(matches!(self.batcher.next_available_within(std::time::Duration::MAX, 1), Next::Closed));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(500))]
    #[test]
    fn unrolls_leave_in_order_and_no_slot_is_lost(
        ahead in 0_usize..4, events in prop::collection::vec(event(), 1..200),
    ) {
        let mut world = World::new(ahead);
        for event in events {
            world.happen(event);
            world.check();
        }
        world.finish();
    }
}

#[test]
fn no_unroll_is_lost_between_many_actors_and_a_trainer_that_takes_what_is_there() {
    const SENDERS: u64 = 8;
    const EACH: u64 = 300;
    let batcher = World::new(1).batcher;
    let trainer = std::thread::spawn({
        let batcher = batcher.clone();
        move || {
            let (mut seen, mut at_most) = (HashSet::new(), 1);
            while seen.len() < (SENDERS * EACH) as usize {
                let Next::Batch(batch) = batcher.next_available_within(std::time::Duration::MAX, at_most) else {
                    panic!("the batcher is open, and unrolls are missing");
                };
                assert!(batch.headers().iter().all(|header| seen.insert(name(header))), "given twice");
                batcher.trained(batch);
                assert!(batcher.accounting().balance());
                at_most = at_most % 6 + 1;
            }
        }
    });
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(3).build().unwrap();
    runtime.block_on(async {
        let senders = (100..100 + SENDERS).map(|incarnation| {
            let batcher = batcher.clone();
            tokio::spawn(async move {
                let actor = Actor::join(&batcher, incarnation);
                for sequence in 0..EACH {
                    let header = actor.header(sequence);
                    assert_eq!(batcher.insert(&header, payload(&header)).await, Outcome::Taken);
                }
            })
        });
        for sender in senders.collect::<Vec<_>>() {
            sender.await.unwrap();
        }
    });
    trainer.join().unwrap();
    let accounting = batcher.accounting();
    assert_eq!((accounting.trained, accounting.in_flight), (SENDERS * EACH, 0));
}
