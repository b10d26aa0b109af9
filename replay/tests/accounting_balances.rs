//! For any sequence of events, produced = trained + dropped + in flight, and no unroll is trained on twice.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::collections::{HashMap, HashSet};

use comic_replay::{Batch, Batcher, Ledger, LedgerSnapshot, Outcome, Phase, Reason, TaskAccounting};
use common::{Actor, CONFIG, PHASE, TASKS, available_now, batch_now, insert_now, layout, task_of, with_tasks};
use proptest::prelude::*;

const ACTORS: u64 = 3;

#[derive(Clone, Debug)]
enum Event {
    Send { actor: u64, skip: u64, version: u64, earlier_phase: bool },
    SendAgain { actor: u64, back: u64 },
    SendInvalid { actor: u64 },
    SendUnknown,
    Take,
    TakeAvailable { at_most: usize },
    Train,
    Discard { reason: Reason },
    DropBatch,
    NewVersion,
    SwitchPhase,
    Reconnect { actor: u64 },
    Replace { actor: u64 },
    Checkpoint,
    Crash,
}

fn event() -> impl Strategy<Value = Event> {
    let reason = prop_oneof![Just(Reason::Stale), Just(Reason::Superseded)];
    prop_oneof![
        20 => (0..ACTORS, prop_oneof![9 => Just(0u64), 1 => 1u64..5], 0u64..7, prop::bool::weighted(0.1))
            .prop_map(|(actor, skip, version, earlier_phase)| Event::Send { actor, skip, version, earlier_phase }),
        3 => (0..ACTORS, 1u64..5).prop_map(|(actor, back)| Event::SendAgain { actor, back }),
        1 => (0..ACTORS).prop_map(|actor| Event::SendInvalid { actor }),
        1 => Just(Event::SendUnknown),
        4 => Just(Event::Take),
        2 => (0..8_usize).prop_map(|at_most| Event::TakeAvailable { at_most }),
        4 => Just(Event::Train),
        1 => reason.prop_map(|reason| Event::Discard { reason }),
        1 => Just(Event::DropBatch),
        4 => Just(Event::NewVersion),
        1 => Just(Event::SwitchPhase),
        1 => (0..ACTORS).prop_map(|actor| Event::Reconnect { actor }),
        1 => (0..ACTORS).prop_map(|actor| Event::Replace { actor }),
        1 => Just(Event::Checkpoint),
        1 => Just(Event::Crash),
    ]
}

/// What the test counts on its own.
#[derive(Clone, Default)]
struct Known {
    /// Next sequence number of each incarnation, as the learner should have it.
    cursors: HashMap<u64, u64>,
    trained: HashSet<(u64, u64)>,
    /// Unrolls of each task, and of no task, that the batcher accepted or dropped.
    decided: [u64; TASKS.len() + 1],
    refused: u64,
}

struct World {
    batcher: Batcher,
    phase: Phase,
    actors: Vec<Actor>,
    /// The next sequence number of each actor. A crash of the learner does not change it.
    sequences: HashMap<u64, u64>,
    incarnations: u64,
    taken: Vec<Batch>,
    known: Known,
    checkpoint: (LedgerSnapshot, Known),
}

impl World {
    fn new() -> Self {
        let batcher = common::batcher();
        let actors = (0..ACTORS).map(|incarnation| Actor::join(&batcher, incarnation)).collect();
        Self {
            checkpoint: (batcher.snapshot(), Known::default()),
            phase: PHASE,
            actors,
            sequences: HashMap::new(),
            incarnations: ACTORS,
            taken: Vec::new(),
            known: Known::default(),
            batcher,
        }
    }

    fn send(&mut self, actor: u64, sequence: u64, version: u64, earlier_phase: bool) {
        let actor = self.actors[actor as usize];
        let mut header = actor.header(sequence);
        header.learner_epoch = self.phase.epoch;
        header.version = self.phase.version.saturating_sub(version);
        if earlier_phase {
            header.version = header.version.min(self.phase.oldest.saturating_sub(1));
        }
        let outcome = insert_now(&self.batcher, &header);
        let cursor = self.known.cursors.entry(actor.incarnation).or_default();
        match outcome {
            None => return,
            Some(Outcome::Taken | Outcome::Stale | Outcome::Superseded) => {
                assert!(sequence >= *cursor);
                *cursor = sequence + 1;
                self.known.decided[task_of(sequence)] += 1;
            }
            Some(Outcome::Duplicate) => assert!(sequence < *cursor),
            Some(other) => panic!("{other:?}"),
        }
        let next = self.sequences.entry(actor.incarnation).or_default();
        *next = (*next).max(sequence + 1);
    }

    fn next_sequence(&self, actor: u64) -> u64 {
        self.sequences.get(&self.actors[actor as usize].incarnation).copied().unwrap_or(0)
    }

    fn take(&mut self, batch: Option<Batch>) {
        let headers = batch.iter().flat_map(Batch::headers);
        let mut ages = headers.map(|header| self.phase.version - header.version);
        assert!(ages.all(|age| age <= CONFIG.max_staleness), "an unroll of the batch is stale");
        self.taken.extend(batch);
    }

    fn train(&mut self) {
        let Some(batch) = self.taken.pop() else { return };
        for header in batch.headers() {
            assert!(self.known.trained.insert((header.incarnation, header.sequence)), "trained on twice");
        }
        self.batcher.trained(batch);
    }

    fn crash(&mut self) {
        let (snapshot, known) = self.checkpoint.clone();
        self.taken.clear();
        self.known = known;
        self.phase.epoch += 1;
        self.batcher = Batcher::new(layout(), CONFIG, self.phase, with_tasks(Ledger::restore(&snapshot).unwrap()));
        for actor in &mut self.actors {
            let joined = self.batcher.join(actor.incarnation, Some(actor.actor)).unwrap();
            actor.actor = joined.actor;
            let known = self.known.cursors.get(&actor.incarnation).copied().unwrap_or(0);
            assert_eq!(joined.next_sequence, known, "the account of the checkpoint");
        }
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Send { actor, skip, version, earlier_phase } => {
                self.send(actor, self.next_sequence(actor) + skip, version, earlier_phase);
            }
            Event::SendAgain { actor, back } => {
                if let Some(sequence) = self.next_sequence(actor).checked_sub(back) {
                    self.send(actor, sequence, 0, false);
                }
            }
            Event::SendInvalid { actor } => {
                let (sequence, actor) = (self.next_sequence(actor), self.actors[actor as usize]);
                assert_eq!(self.batcher.refuse_invalid(&actor.header(sequence)), Outcome::Invalid);
                self.sequences.insert(actor.incarnation, sequence + 1);
                self.known.cursors.insert(actor.incarnation, sequence + 1);
            }
            Event::SendUnknown => {
                let stranger = Actor { actor: 0, incarnation: u64::MAX };
                assert_eq!(stranger.send(&self.batcher, 0), Some(Outcome::NotJoined));
                self.known.refused += 1;
            }
            Event::Take => self.take(batch_now(&self.batcher)),
            Event::TakeAvailable { at_most } => {
                let batch = available_now(&self.batcher, at_most);
                assert!(batch.iter().all(|batch| (1..=at_most).contains(&batch.unrolls)));
                self.take(batch);
            }
            Event::Train => self.train(),
            Event::Discard { reason } => {
                if let Some(batch) = self.taken.pop() {
                    self.batcher.discard(batch, reason);
                }
            }
            Event::DropBatch => drop(self.taken.pop()),
            Event::NewVersion => {
                self.phase.version += 1;
                self.batcher.set_phase(self.phase);
            }
            Event::SwitchPhase => {
                self.phase.version += 1;
                self.phase.oldest = self.phase.version;
                self.batcher.set_phase(self.phase);
            }
            Event::Reconnect { actor } => {
                let acknowledged = self.next_sequence(actor);
                let actor = self.actors[actor as usize];
                assert_eq!(self.batcher.join(actor.incarnation, Some(actor.actor)).unwrap().actor, actor.actor);
                assert_eq!(self.batcher.catch_up(actor.actor, acknowledged), Some(acknowledged));
                self.known.cursors.insert(actor.incarnation, acknowledged);
            }
            Event::Replace { actor } => {
                self.actors[actor as usize] = Actor::join(&self.batcher, self.incarnations);
                self.incarnations += 1;
            }
            Event::Checkpoint => self.checkpoint = (self.batcher.snapshot(), self.known.clone()),
            Event::Crash => self.crash(),
        }
    }

    fn check(&self) {
        let accounting = self.batcher.accounting();
        assert!(accounting.balance(), "{accounting:?}");
        assert_eq!(accounting.produced, self.known.cursors.values().sum::<u64>(), "sum of the sequence numbers");
        assert_eq!(accounting.trained, self.known.trained.len() as u64);
        assert_eq!(accounting.unattributed, self.known.refused);
        // One batch for the trainer, two that are assembled, and one of what was available.
        assert!(accounting.in_flight <= 4 * CONFIG.unrolls as u64);
        assert_eq!(self.batcher.snapshot().accounting, accounting);
        self.check_tasks();
    }
}

impl World {
    fn check_tasks(&self) {
        let accounting = self.batcher.accounting_by_task();
        assert_eq!(accounting.all, self.batcher.accounting());
        assert_eq!(accounting.tasks, self.batcher.snapshot().tasks);
        for (index, task) in TASKS.iter().enumerate() {
            let own = accounting.tasks[*task];
            assert!(own.balance(), "{task}: {own:?}");
            assert_eq!(own.produced, self.known.decided[index], "{task}");
            let trained = self.known.trained.iter().filter(|(_, sequence)| task_of(*sequence) == index);
            assert_eq!(own.trained, trained.count() as u64, "{task}");
        }
        let sum = |part: fn(&TaskAccounting) -> u64| accounting.tasks.values().map(part).sum::<u64>();
        let without_task = self.known.trained.iter().filter(|(_, sequence)| task_of(*sequence) == TASKS.len()).count();
        assert_eq!(
            sum(|accounting| accounting.trained) + without_task as u64,
            accounting.all.trained,
            "sum over the tasks"
        );
        assert!(sum(|accounting| accounting.in_flight) <= accounting.all.in_flight);
        assert!(sum(|accounting| accounting.dropped.total()) <= accounting.all.dropped.total());
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(500))]
    #[test]
    fn the_accounting_balances_after_every_event(events in prop::collection::vec(event(), 1..200)) {
        let mut world = World::new();
        for event in events {
            world.happen(event);
            world.check();
        }
    }
}
