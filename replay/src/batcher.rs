//! The assembly of batches, between service and trainer.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use comic_proto::v1::UnrollHeader;
use comic_proto::{Pieces, UnrollLayout};
use parking_lot::{Condvar, Mutex, MutexGuard};
use tokio::sync::Semaphore;

use crate::accounting::{Accounting, AccountingByTask, Reason};
use crate::batch::{Batch, TakeBack};
use crate::buffer::Buffer;
use crate::config::{BatchOrder, Config};
use crate::ledger::{JoinError, Joined, Ledger, SequenceStatus};
use crate::next::Next;
use crate::phase::Phase;
use crate::snapshot::LedgerSnapshot;

/// The result of inserting an unroll.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The unroll is in a batch.
    Taken,
    /// Dropped: its parameters were too old.
    Stale,
    /// Dropped: it does not have this layout, or was refused as invalid.
    Invalid,
    /// Dropped: it was made in another epoch or phase.
    Superseded,
    /// It is a duplicate of an unroll of the accounting.
    Duplicate,
    /// Actor and incarnation have no account; the actor must join first.
    NotJoined,
    /// The batcher is closed; nothing was recorded.
    Closed,
}

struct State {
    ledger: Ledger,
    phase: Phase,
    /// The batch that the trainer gets next. It was full; stale unrolls may have left free slots.
    next: Option<Buffer>,
    /// The batch that is filled while `next` is full.
    open: Option<Buffer>,
    free: Vec<Buffer>,
    /// How long inserts have waited for a slot, all together.
    waited: Duration,
    closed: bool,
}

struct Inner {
    layout: Arc<UnrollLayout>,
    config: Config,
    /// One lock protects all mutable state, so it is always consistent.
    state: Mutex<State>,
    /// One permit for each slot of `next` and `open` that is neither filled nor reserved by an insert. Inserts get
    /// permits in the order in which they wait. A waiting insert needs only its own memory.
    slots: Semaphore,
    /// A batch is full.
    filled: Condvar,
    /// An unroll waits, or memory for the trainer is free.
    arrived: Condvar,
}

/// Assembles batches in bounded memory, with each unroll in at most one batch. A batcher is a handle that can be
/// cloned. The documentation of the crate has the rules.
#[derive(Clone)]
pub struct Batcher {
    inner: Arc<Inner>,
}

impl Batcher {
    /// An empty batcher that continues the accounting of `ledger`.
    pub fn new(layout: Arc<UnrollLayout>, config: Config, phase: Phase, ledger: Ledger) -> Self {
        // The next unroll of an environment belongs to the next batch, so no batch can be assembled ahead.
        let ahead = if config.order == BatchOrder::Environment { 0 } else { config.ahead };
        let config = Config { unrolls: config.unrolls.max(1), ahead, ..config };
        let mut free: Vec<_> =
            (0..=config.ahead + config.spare()).map(|_| Buffer::new(Arc::clone(&layout), config.unrolls)).collect();
        let open = free.pop();
        let state = Mutex::new(State { ledger, phase, next: None, open, free, waited: Duration::ZERO, closed: false });
        let slots = Semaphore::new(config.unrolls);
        let (filled, arrived) = (Condvar::new(), Condvar::new());
        Self { inner: Arc::new(Inner { layout, config, state, slots, filled, arrived }) }
    }

    /// Opens an account, or finds the account of this incarnation. See [`Ledger::join`].
    ///
    /// # Errors
    /// [`JoinError::Closed`] if its account was closed.
    pub fn join(&self, incarnation: u64, claimed: Option<u64>) -> Result<Joined, JoinError> {
        self.lock().ledger.join(incarnation, claimed)
    }

    /// See [`Ledger::catch_up`].
    pub fn catch_up(&self, actor: u64, sequence: u64) -> Option<u64> {
        self.lock().ledger.catch_up(actor, sequence)
    }

    /// Puts a validated unroll into a batch. If no slot is free, it waits, without a time limit.
    ///
    /// It is cancel-safe: nothing has happened until it returns.
    pub async fn insert(&self, header: &UnrollHeader, payload: impl Into<Pieces>) -> Outcome {
        let payload = payload.into();
        // An unroll that is refused need not wait for a slot.
        if let Some(outcome) = self.refuse(&mut self.lock(), header, &payload) {
            return outcome;
        }
        let began = Instant::now();
        let Ok(slot) = self.inner.slots.acquire().await else { return Outcome::Closed };
        let mut state = self.lock();
        state.waited += began.elapsed();
        if let Some(outcome) = self.refuse(&mut state, header, &payload) {
            return outcome;
        }
        let State { ledger, next, open, .. } = &mut *state;
        let unfilled = [next, open].into_iter().flatten().find(|batch| !batch.is_full());
        let Some(batch) = unfilled else { return Outcome::Closed };
        let index = match self.inner.config.order {
            BatchOrder::Arrival => batch.first_free(),
            BatchOrder::Environment => header.environment as usize,
        };
        if !ledger.record(header.actor, header.sequence, Some(header.task)) {
            ledger.refuse();
            return Outcome::Invalid;
        }
        batch.put(index, UnrollHeader { layout_hash: Vec::new(), ..header.clone() }, &payload);
        slot.forget();
        self.settle(&mut state);
        Outcome::Taken
    }

    /// Records an unroll that failed validation. It is dropped as invalid if its header has an account; otherwise it is
    /// counted as unattributed.
    pub fn refuse_invalid(&self, header: &UnrollHeader) -> Outcome {
        let mut state = self.lock();
        if state.closed {
            return Outcome::Closed;
        }
        if let Some(outcome) = refuse_unaccountable(&mut state.ledger, header) {
            return outcome;
        }
        drop_unroll(&mut state.ledger, header, None, Reason::Invalid)
    }

    /// Counts a message without a header as unattributed.
    pub fn refuse_unattributed(&self) {
        self.lock().ledger.refuse();
    }

    /// Begins a phase. Waiting unrolls of another epoch or phase are dropped as superseded.
    pub fn set_phase(&self, phase: Phase) {
        let mut state = self.lock();
        let terms = |phase: Phase| (phase.epoch, phase.oldest);
        let has_changed = terms(state.phase) != terms(phase);
        state.phase = phase;
        if has_changed {
            self.drop_waiting(&mut state, Reason::Superseded, |_| true);
        }
    }

    /// The phase at this moment.
    pub fn phase(&self) -> Phase {
        self.lock().phase
    }

    /// The next full batch; `None` if the batcher is closed. Blocks the calling thread.
    pub fn next_batch(&self) -> Option<Batch> {
        loop {
            match self.next_batch_within(Duration::MAX) {
                Next::Batch(batch) => return Some(batch),
                Next::Closed => return None,
                Next::Elapsed => {}
            }
        }
    }

    /// The next full batch, if there is one within this time. Blocks the calling thread.
    pub fn next_batch_within(&self, timeout: Duration) -> Next {
        self.next_within(timeout, &self.inner.filled, |state| self.take_next(state))
    }

    /// The unrolls that wait now, at least one and at most `at_most`, the oldest first, as soon as there is one within
    /// this time. They need not fill a batch, and are in the first slots of the batch that is returned. The trainer
    /// should return it before it asks for more: memory for one such batch is certain. Blocks the calling thread.
    ///
    /// Lockstep ([`BatchOrder::Environment`]) takes full batches and must not use this.
    pub fn next_available_within(&self, timeout: Duration, at_most: usize) -> Next {
        debug_assert_eq!(self.inner.config.order, BatchOrder::Arrival, "lockstep takes full batches");
        self.next_within(timeout, &self.inner.arrived, |state| self.take_available(state, at_most))
    }

    /// Accounts for a batch as trained on, and reuses its memory.
    pub fn trained(&self, batch: Batch) {
        batch.finish(None);
    }

    /// Accounts for a batch as dropped for this reason, and reuses its memory.
    pub fn discard(&self, batch: Batch, reason: Reason) {
        batch.finish(Some(reason));
    }

    /// The accounting at this moment.
    pub fn accounting(&self) -> Accounting {
        self.accounting_by_task().all
    }

    /// The accounting at this moment, in total and of each task.
    pub fn accounting_by_task(&self) -> AccountingByTask {
        let state = self.lock();
        state.ledger.accounting(state.waiting())
    }

    /// Unrolls that the batches have room for: those of the open batch, of full ones, and of the trainer's.
    pub fn capacity(&self) -> usize {
        let Config { unrolls, ahead, .. } = self.inner.config;
        (ahead + 1) * unrolls
    }

    /// How long unrolls have waited for a slot since the beginning, all together.
    pub fn waited(&self) -> Duration {
        self.lock().waited
    }

    /// The ledger for a checkpoint.
    pub fn snapshot(&self) -> LedgerSnapshot {
        let state = self.lock();
        state.ledger.snapshot(state.waiting())
    }

    /// The layout of its unrolls.
    pub fn layout(&self) -> &Arc<UnrollLayout> {
        &self.inner.layout
    }

    /// Closes the batcher: inserts and the trainer stop waiting, and all later calls return at once.
    pub fn close(&self) {
        self.lock().closed = true;
        self.inner.slots.close();
        self.inner.filled.notify_all();
        self.inner.arrived.notify_all();
    }

    /// Whether the batcher is closed.
    pub fn is_closed(&self) -> bool {
        self.lock().closed
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.inner.state.lock()
    }

    /// Applies every rule that keeps an unroll out of a batch. Returns `None` and records nothing if no rule applies.
    fn refuse(&self, state: &mut State, header: &UnrollHeader, payload: &Pieces) -> Option<Outcome> {
        if state.closed {
            return Some(Outcome::Closed);
        }
        if let Some(outcome) = refuse_unaccountable(&mut state.ledger, header) {
            return Some(outcome);
        }
        let Phase { epoch, version, oldest } = state.phase;
        let other = header.learner_epoch != epoch || header.version < oldest;
        let reason = if other {
            Reason::Superseded
        } else if payload.len() != self.inner.layout.size() {
            Reason::Invalid
        } else if self.is_stale(header, version) {
            Reason::Stale
        } else if !self.has_room_for(state, header) {
            Reason::Invalid
        } else {
            return None;
        };
        // The task of an invalid header is unknown. In another epoch the tasks may have had other numbers.
        let has_task = header.learner_epoch == epoch && reason != Reason::Invalid;
        let task = has_task.then_some(header.task);
        Some(drop_unroll(&mut state.ledger, header, task, reason))
    }

    /// Waits until `take` gives a buffer. It is tried again after each signal of `changed`.
    fn next_within(&self, timeout: Duration, changed: &Condvar, take: impl Fn(&mut State) -> Option<Buffer>) -> Next {
        // A timeout that is too long for the clock is no deadline.
        let deadline = Instant::now().checked_add(timeout);
        let mut state = self.lock();
        loop {
            if state.closed {
                return Next::Closed;
            }
            if let Some(buffer) = take(&mut state) {
                state.ledger.hand_out(buffer.tasks());
                self.settle(&mut state);
                drop(state);
                return Next::Batch(Batch::new(self.inner.layout.clone(), buffer, Box::new(self.clone())));
            }
            let left = deadline.map_or(Duration::MAX, |end| end.saturating_duration_since(Instant::now()));
            if left.is_zero() {
                return Next::Elapsed;
            }
            changed.wait_for(&mut state, left);
        }
    }

    /// Drops unrolls that wait in the batcher and frees their slots.
    fn drop_waiting(&self, state: &mut State, reason: Reason, dropped: impl Fn(&UnrollHeader) -> bool) {
        let waiting = [&mut state.next, &mut state.open].into_iter().flatten();
        let removed: Vec<u32> = waiting.flat_map(|batch| batch.retain(|header| !dropped(header))).collect();
        self.reuse_slots(state, removed.len());
        removed.into_iter().for_each(|task| state.ledger.end(Some(task), Some(reason)));
    }

    /// Gives the slots of `removed` unrolls to other inserts. Reservations of waiting inserts stay. The remaining
    /// unrolls of the open batch fill the next one, so those of the next batch are always older.
    fn reuse_slots(&self, state: &mut State, removed: usize) {
        if let (Some(next), Some(open)) = (&mut state.next, &mut state.open) {
            next.move_from(open, usize::MAX);
        }
        self.inner.slots.add_permits(removed);
    }

    /// At most `at_most` of the waiting unrolls, after stale unrolls are dropped.
    fn take_available(&self, state: &mut State, at_most: usize) -> Option<Buffer> {
        let version = state.phase.version;
        self.drop_waiting(state, Reason::Stale, |header| self.is_stale(header, version));
        if at_most >= self.inner.config.unrolls
            && let Some(full) = state.next.take_if(|next| next.is_full() && next.is_in_order())
        {
            return Some(full);
        }
        if at_most == 0 || state.waiting().next().is_none() {
            return None;
        }
        let mut taken = state.free.pop()?;
        for batch in [&mut state.next, &mut state.open].into_iter().flatten() {
            taken.move_from(batch, at_most - taken.len());
        }
        self.reuse_slots(state, taken.len());
        Some(taken)
    }

    /// The next batch, if it is full after stale unrolls are dropped.
    fn take_next(&self, state: &mut State) -> Option<Buffer> {
        state.next.as_ref()?.is_full().then_some(())?;
        let version = state.phase.version;
        self.drop_waiting(state, Reason::Stale, |header| self.is_stale(header, version));
        state.next.take_if(|next| next.is_full())
    }

    fn is_stale(&self, header: &UnrollHeader, version: u64) -> bool {
        version.saturating_sub(header.version) > self.inner.config.max_staleness
    }

    /// Whether an unroll of this environment can get a slot.
    fn has_room_for(&self, state: &State, header: &UnrollHeader) -> bool {
        let BatchOrder::Environment = self.inner.config.order else { return true };
        let environment = header.environment as usize;
        let waiting = [&state.next, &state.open].into_iter().flatten();
        environment < self.inner.config.unrolls
            && waiting.filter(|batch| !batch.is_full()).all(|batch| batch.is_free(environment))
    }

    /// Moves buffers: a full open batch becomes the next one if there is none, and a free buffer becomes the open
    /// batch. One buffer stays free for [`take_available`](Self::take_available).
    fn settle(&self, state: &mut State) {
        if state.next.is_none() {
            state.next = state.open.take_if(|open| open.is_full());
        }
        if state.next.as_ref().is_some_and(Buffer::is_full) {
            self.inner.filled.notify_one();
        }
        if state.waiting().next().is_some() {
            self.inner.arrived.notify_one();
        }
        if state.open.is_none()
            && state.free.len() > self.inner.config.spare()
            && let Some(buffer) = state.free.pop()
        {
            state.open = Some(buffer);
            self.inner.slots.add_permits(self.inner.config.unrolls);
        }
    }
}

impl TakeBack for Batcher {
    fn take_back(&self, mut buffer: Buffer, dropped: Option<Reason>) {
        let mut state = self.lock();
        buffer.tasks().for_each(|task| state.ledger.take_back(task, dropped));
        buffer.clear();
        state.free.push(buffer);
        self.settle(&mut state);
    }
}

impl State {
    /// The tasks of the unrolls that wait for the trainer.
    fn waiting(&self) -> impl Iterator<Item = u32> {
        [&self.next, &self.open].into_iter().flatten().flat_map(Buffer::tasks)
    }
}

/// Refuses and counts an unroll that its account does not expect; `None` if it is new.
fn refuse_unaccountable(ledger: &mut Ledger, header: &UnrollHeader) -> Option<Outcome> {
    match ledger.status(header.actor, header.incarnation, header.sequence) {
        SequenceStatus::New => None,
        SequenceStatus::Duplicate => {
            ledger.repeat();
            Some(Outcome::Duplicate)
        }
        SequenceStatus::OutOfRange => {
            ledger.refuse();
            Some(Outcome::Invalid)
        }
        SequenceStatus::Unknown => {
            ledger.refuse();
            Some(Outcome::NotJoined)
        }
    }
}

/// Records an unroll as dropped.
fn drop_unroll(ledger: &mut Ledger, header: &UnrollHeader, task: Option<u32>, reason: Reason) -> Outcome {
    if !ledger.record(header.actor, header.sequence, task) {
        ledger.refuse();
        return Outcome::Invalid;
    }
    ledger.end(task, Some(reason));
    match reason {
        Reason::Stale => Outcome::Stale,
        Reason::Invalid => Outcome::Invalid,
        Reason::Superseded | Reason::LostAtRestart => Outcome::Superseded,
    }
}

impl fmt::Debug for Batcher {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Batcher").field("accounting", &self.accounting()).finish_non_exhaustive()
    }
}
