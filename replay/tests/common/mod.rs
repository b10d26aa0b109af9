//! Small unrolls, and actors that send them.
#![allow(dead_code, clippy::unwrap_used, clippy::expect_used)]

pub(crate) mod items;

use std::future::Future;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};

use bytes::Bytes;
use comic_proto::v1::UnrollHeader;
use comic_proto::{Field, UnrollBuffer, UnrollLayout, UnrollShape};
use comic_replay::{Batch, BatchOrder, Batcher, Config, Ledger, Next, Outcome, Phase};

pub(crate) const PHASE: Phase = Phase { epoch: 1, version: 10, oldest: 0 };
/// The phase after it: unrolls of its version are superseded.
pub(crate) const NEXT_PHASE: Phase = Phase { version: PHASE.version + 1, oldest: PHASE.version + 1, ..PHASE };
pub(crate) const CONFIG: Config = Config { unrolls: 3, max_staleness: 4, ahead: 2, order: BatchOrder::Arrival };
/// Slots that can be filled without a trainer: those of the open batch and of the full one.
pub(crate) const SLOTS: usize = 2 * CONFIG.unrolls;

pub(crate) fn layout() -> Arc<UnrollLayout> {
    let shape = UnrollShape {
        length: 2,
        proprioception: 3,
        task: 4,
        action: 2,
        latent: 1,
        reward_terms: 2,
        image: 0,
        components: 1,
        state: 0,
        action_gradient: 0,
    };
    Arc::new(UnrollLayout::new(shape))
}

/// An actor's first ten unrolls belong to the first task, its next ten to the second, and all later ones to no task.
pub(crate) const TASKS: [&str; 2] = ["tracking", "get-up"];
/// See [`TASKS`].
pub(crate) const UNROLLS_OF_A_TASK: usize = 10;

/// The index of the task of an actor's unroll; the number of tasks for no task.
pub(crate) fn task_of(sequence: u64) -> usize {
    (sequence as usize / UNROLLS_OF_A_TASK).min(TASKS.len())
}

/// The ledger with the accounting of [`TASKS`].
pub(crate) fn with_tasks(ledger: Ledger) -> Ledger {
    ledger.with_tasks(TASKS.map(String::from))
}

pub(crate) fn batcher() -> Batcher {
    Batcher::new(layout(), CONFIG, PHASE, with_tasks(Ledger::new()))
}

/// An actor that has joined.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Actor {
    pub(crate) actor: u64,
    pub(crate) incarnation: u64,
}

impl Actor {
    pub(crate) fn join(batcher: &Batcher, incarnation: u64) -> Self {
        Self { actor: batcher.join(incarnation, None).unwrap().actor, incarnation }
    }

    pub(crate) fn header(self, sequence: u64) -> UnrollHeader {
        UnrollHeader {
            actor: self.actor,
            incarnation: self.incarnation,
            sequence,
            learner_epoch: PHASE.epoch,
            version: PHASE.version,
            layout_hash: layout().hash().to_vec(),
            episodes: Vec::new(),
            environment: 0,
            task: task_of(sequence) as u32,
        }
    }

    /// Sends unroll `sequence`. If it would have to wait, it is cancelled, and the result is `None`.
    pub(crate) fn send(self, batcher: &Batcher, sequence: u64) -> Option<Outcome> {
        insert_now(batcher, &self.header(sequence))
    }
}

/// An unroll in which every number identifies the actor, the unroll, the field and the row.
pub(crate) fn payload(header: &UnrollHeader) -> Bytes {
    let layout = layout();
    let mut unroll = UnrollBuffer::new(&layout);
    for field in Field::ALL.into_iter().filter(|field| *field != Field::Clip) {
        for t in 0..layout.rows(field) {
            unroll.row_mut(field, t).fill(mark(header, field, t));
        }
    }
    for t in 0..layout.rows(Field::Clip) {
        unroll.set_clip(t, header.sequence as u32);
    }
    unroll.into_bytes()
}

pub(crate) fn mark(header: &UnrollHeader, field: Field, t: usize) -> f32 {
    header.actor as f32 * 10_000.0 + header.sequence as f32 * 100.0 + (field as usize * 4 + t) as f32 / 64.0
}

/// Inserts an unroll. If it would have to wait, the future is dropped.
pub(crate) fn insert_now(batcher: &Batcher, header: &UnrollHeader) -> Option<Outcome> {
    now(&mut Box::pin(batcher.insert(header, payload(header))))
}

/// Polls a future once.
pub(crate) fn now<T>(future: &mut (impl Future<Output = T> + Unpin)) -> Option<T> {
    match std::pin::Pin::new(future).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(value) => Some(value),
        Poll::Pending => None,
    }
}

/// The full batch, if there is one.
pub(crate) fn batch_now(batcher: &Batcher) -> Option<Batch> {
    match batcher.next_batch_within(std::time::Duration::ZERO) {
        Next::Batch(batch) => Some(batch),
        Next::Elapsed | Next::Closed => None,
    }
}

/// At most `at_most` of the unrolls that wait, if there are any.
pub(crate) fn available_now(batcher: &Batcher, at_most: usize) -> Option<Batch> {
    match batcher.next_available_within(std::time::Duration::ZERO, at_most) {
        Next::Batch(batch) => Some(batch),
        Next::Elapsed | Next::Closed => None,
    }
}

/// Checks that a batch has exactly these unrolls, in this order and field by field.
pub(crate) fn assert_holds(batch: &Batch, expected: &[UnrollHeader]) {
    assert_eq!((batch.unrolls, batch.headers().len()), (expected.len(), expected.len()));
    assert_eq!(batch.as_unrolls().len(), expected.len());
    for (slot, header) in expected.iter().enumerate() {
        assert_eq!(batch.headers()[slot].sequence, header.sequence);
        for field in Field::ALL.into_iter().filter(|field| *field != Field::Clip) {
            let (rows, width) = (batch.layout.rows(field), batch.layout.width(field));
            for t in 0..rows {
                let start = (slot * rows + t) * width;
                assert_eq!(batch.f32(field)[start..start + width], vec![mark(header, field, t); width], "{field}[{t}]");
            }
            assert_eq!(batch.f32(field).len(), expected.len() * rows * width);
        }
        assert_eq!(batch.clip()[slot * 3..(slot + 1) * 3], [header.sequence as u32; 3]);
    }
    assert_eq!(batch.clip().len(), 3 * expected.len());
}

/// The memory of this process, bytes: `VmRSS:`, what is resident, or `VmHWM:`, the most that ever was.
#[cfg(target_os = "linux")]
pub(crate) fn memory_of_process(what: &str) -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix(what)).unwrap();
    1024 * line.trim().trim_end_matches(" kB").parse::<u64>().unwrap()
}
