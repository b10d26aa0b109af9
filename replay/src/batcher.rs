//! Where network tasks and the trainer meet.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use comic_proto::v1::{Behaviour, UnrollHeader};
use comic_proto::{Pieces, UnrollLayout};
use parking_lot::{Condvar, Mutex, MutexGuard};
use tokio::sync::Semaphore;

use crate::batch::{Batch, Buffer};
use crate::ledger::{Accounting, JoinError, Joined, Ledger, Reason, Sighting};
use crate::snapshot::Snapshot;
use crate::tasks::AccountingByTask;

/// What does not change while a batcher lives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// B: unrolls a batch, at least 1.
    pub unrolls: usize,
    /// An unroll may be so many published versions old, when it comes and when its batch is handed out.
    pub max_staleness: u64,
    /// Batches that may be assembled while one is trained on. With 0 nothing is taken meanwhile, and what waits is as
    /// fresh as can be; with 1 the next batch is ready when the trainer is.
    pub ahead: usize,
    /// In which order unrolls stand in a batch.
    pub order: BatchOrder,
}

/// Which slot of a batch an unroll takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BatchOrder {
    /// The next one: first come, first served.
    Arrival,
    /// That of its environment's number. A batch has one unroll of each of B environments, and no order of arrival can
    /// be told from it.
    Environment,
}

/// What the trainer wants at this moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Phase {
    /// The learner's epoch.
    pub epoch: u64,
    /// The newest published version; versions count publications.
    pub version: u64,
    /// Unrolls of versions before this one are superseded: they were made under other conditions.
    pub oldest: u64,
    /// Unrolls of the other behaviour are superseded.
    pub behaviour: Behaviour,
}

impl Phase {
    /// The phase in which an epoch of the learner begins: nothing is published yet, and the policy acts.
    pub fn begin(epoch: u64) -> Self {
        Self { epoch, version: 0, oldest: 0, behaviour: Behaviour::Policy }
    }
}

/// What became of an unroll.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// It is in a batch.
    Taken,
    /// Dropped: its parameters are too old.
    Stale,
    /// Dropped: it is no unroll of this layout, or was refused as invalid.
    Invalid,
    /// Dropped: of another epoch or phase.
    Superseded,
    /// Accounted for before.
    Duplicate,
    /// This actor and incarnation have no account: they have to join first.
    NotJoined,
    /// The batcher is closed; nothing was recorded.
    Closed,
}

/// What waiting for a batch led to.
#[derive(Debug)]
pub enum Next {
    /// A full batch.
    Batch(Batch),
    /// The time is over.
    Elapsed,
    /// The batcher is closed.
    Closed,
}

struct State {
    ledger: Ledger,
    phase: Phase,
    /// The batch that is handed out next: it was full once, and unrolls that grew too old in it leave slots.
    next: Option<Buffer>,
    /// What is filled when the next one is full.
    open: Option<Buffer>,
    free: Vec<Buffer>,
    closed: bool,
}

struct Inner {
    layout: Arc<UnrollLayout>,
    config: Config,
    /// Everything that must agree with everything else stands behind this one lock.
    state: Mutex<State>,
    /// A permit for each slot of the next and the open batch that is neither filled nor promised to somebody: first
    /// come, first served, and a waiting insert costs no memory but its own.
    slots: Semaphore,
    filled: Condvar,
}

/// Bounded, exactly-once assembly of batches; a handle that can be cloned. See the crate's rules.
#[derive(Clone)]
pub struct Batcher {
    inner: Arc<Inner>,
}

impl Batcher {
    /// An empty batcher that carries on these accounting.
    pub fn new(layout: Arc<UnrollLayout>, config: Config, phase: Phase, ledger: Ledger) -> Self {
        // An environment's next unroll is of the next batch, which has to wait.
        let ahead = if config.order == BatchOrder::Environment { 0 } else { config.ahead };
        let config = Config { unrolls: config.unrolls.max(1), ahead, ..config };
        let mut free: Vec<_> = (0..=config.ahead).map(|_| Buffer::new(&layout, config.unrolls)).collect();
        let open = free.pop();
        let state = Mutex::new(State { ledger, phase, next: None, open, free, closed: false });
        let slots = Semaphore::new(config.unrolls);
        Self { inner: Arc::new(Inner { layout, config, state, slots, filled: Condvar::new() }) }
    }

    /// Opens an account, or finds the one this incarnation has; see [`Ledger::join`].
    ///
    /// # Errors
    /// [`JoinError::Closed`] when it had an account that was closed.
    pub fn join(&self, incarnation: u64, claimed: Option<u64>) -> Result<Joined, JoinError> {
        self.lock().ledger.join(incarnation, claimed)
    }

    /// See [`Ledger::catch_up`].
    pub fn catch_up(&self, actor: u64, sequence: u64) -> u64 {
        self.lock().ledger.catch_up(actor, sequence)
    }

    /// Puts a validated unroll into a batch, waiting for a slot as long as it takes, or says why not.
    ///
    /// Cancel-safe: until it returns, nothing has happened.
    pub async fn insert(&self, header: &UnrollHeader, payload: impl Into<Pieces>) -> Outcome {
        let payload = payload.into();
        // What is refused anyway does not queue for a slot.
        if let Some(outcome) = self.refuse(&mut self.lock(), header, &payload) {
            return outcome;
        }
        let Ok(slot) = self.inner.slots.acquire().await else { return Outcome::Closed };
        let mut state = self.lock();
        if let Some(outcome) = self.refuse(&mut state, header, &payload) {
            return outcome;
        }
        let State { ledger, next, open, .. } = &mut *state;
        let unfilled = [next, open].into_iter().flatten().find(|batch| !batch.is_full());
        let Some(batch) = unfilled else { return Outcome::Closed };
        let place = match self.inner.config.order {
            BatchOrder::Arrival => batch.first_free(),
            BatchOrder::Environment => header.environment as usize,
        };
        if !ledger.record(header.actor, header.sequence, Some(header.task)) {
            ledger.refuse();
            return Outcome::Invalid;
        }
        batch.put(&self.inner.layout, place, UnrollHeader { layout_hash: Vec::new(), ..header.clone() }, &payload);
        slot.forget();
        self.settle(&mut state);
        Outcome::Taken
    }

    /// Records an unroll that failed validation: dropped as invalid if its header has an account, or else refused
    /// without one.
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

    /// Counts a message without so much as a header.
    pub fn refuse_unattributed(&self) {
        self.lock().ledger.refuse();
    }

    /// Says what is wanted from now on. What waits in the batcher for another epoch or phase is superseded.
    pub fn set_phase(&self, phase: Phase) {
        let mut state = self.lock();
        let terms = |phase: Phase| (phase.epoch, phase.oldest, phase.behaviour);
        let over = terms(state.phase) != terms(phase);
        state.phase = phase;
        if !over {
            return;
        }
        self.drop_waiting(&mut state, Reason::Superseded, |_| true);
    }

    /// What is wanted at this moment.
    pub fn phase(&self) -> Phase {
        self.lock().phase
    }

    /// The next full batch; blocks the calling thread. `None` once the batcher is closed.
    pub fn next_batch(&self) -> Option<Batch> {
        loop {
            match self.next_batch_within(Duration::MAX) {
                Next::Batch(batch) => return Some(batch),
                Next::Closed => return None,
                Next::Elapsed => {}
            }
        }
    }

    /// The next full batch, if there is one within this time; blocks the calling thread.
    pub fn next_batch_within(&self, patience: Duration) -> Next {
        // Patience beyond what the clock can express is no deadline.
        let deadline = Instant::now().checked_add(patience);
        let mut state = self.lock();
        loop {
            if state.closed {
                return Next::Closed;
            }
            if let Some(buffer) = self.take_next(&mut state) {
                state.ledger.hand_out(buffer.tasks());
                self.settle(&mut state);
                drop(state);
                return Next::Batch(Batch::new(self.inner.layout.clone(), buffer, self.clone()));
            }
            let left = deadline.map_or(Duration::MAX, |end| end.saturating_duration_since(Instant::now()));
            if left.is_zero() {
                return Next::Elapsed;
            }
            self.inner.filled.wait_for(&mut state, left);
        }
    }

    /// Accounting a batch as trained on and takes its memory back.
    pub fn trained(&self, batch: Batch) {
        batch.finish(None);
    }

    /// Accounting a batch as dropped for this reason and takes its memory back.
    pub fn discard(&self, batch: Batch, reason: Reason) {
        batch.finish(Some(reason));
    }

    /// The accounting at this moment.
    pub fn accounting(&self) -> Accounting {
        self.accounting_by_task().all
    }

    /// The accounting at this moment, and each task's.
    pub fn accounting_by_task(&self) -> AccountingByTask {
        let state = self.lock();
        state.ledger.accounting(state.waiting())
    }

    /// Accounting and accounts for a checkpoint.
    pub fn snapshot(&self) -> Snapshot {
        let state = self.lock();
        state.ledger.snapshot(state.waiting())
    }

    /// The layout of its unrolls.
    pub fn layout(&self) -> &Arc<UnrollLayout> {
        &self.inner.layout
    }

    /// Ends all waiting, of inserts and of the trainer, now and for ever.
    pub fn close(&self) {
        self.lock().closed = true;
        self.inner.slots.close();
        self.inner.filled.notify_all();
    }

    /// Whether all waiting has ended.
    pub fn is_closed(&self) -> bool {
        self.lock().closed
    }

    /// Takes a buffer back from a [`Batch`] whose unrolls were trained on, or dropped for a reason.
    pub(crate) fn take_back(&self, mut buffer: Buffer, end: Option<Reason>) {
        let mut state = self.lock();
        buffer.tasks().for_each(|task| state.ledger.take_back(task, end));
        buffer.clear();
        state.free.push(buffer);
        self.settle(&mut state);
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.inner.state.lock()
    }

    /// Applies every rule that keeps an unroll out of a batch. `None`, and nothing recorded, if there is none.
    fn refuse(&self, state: &mut State, header: &UnrollHeader, payload: &Pieces) -> Option<Outcome> {
        if state.closed {
            return Some(Outcome::Closed);
        }
        if let Some(outcome) = refuse_unaccountable(&mut state.ledger, header) {
            return Some(outcome);
        }
        let Phase { epoch, version, oldest, behaviour } = state.phase;
        let other = header.learner_epoch != epoch || header.behaviour() != behaviour || header.version < oldest;
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
        // An invalid header says nothing. The tasks of another epoch may have had other numbers.
        let has_task = header.learner_epoch == epoch && reason != Reason::Invalid;
        let task = has_task.then_some(header.task);
        Some(drop_unroll(&mut state.ledger, header, task, reason))
    }

    /// Drops unrolls that wait in the batcher. Their slots are free again; those promised to waiting inserts stay
    /// promised. What is left of the open batch makes the next one full.
    fn drop_waiting(&self, state: &mut State, reason: Reason, dropped: impl Fn(&UnrollHeader) -> bool) {
        let (layout, State { ledger, next, open, .. }) = (&self.inner.layout, state);
        let waiting = [&mut *next, &mut *open].into_iter().flatten();
        let removed: Vec<u32> = waiting.flat_map(|batch| batch.retain(|header| !dropped(header))).collect();
        if let (Some(next), Some(open)) = (next, open) {
            next.fill_from(layout, open);
        }
        self.inner.slots.add_permits(removed.len());
        removed.into_iter().for_each(|task| ledger.end(Some(task), Some(reason)));
    }

    /// The next batch, if it is full without what grew too old while it waited.
    fn take_next(&self, state: &mut State) -> Option<Buffer> {
        state.next.as_ref()?.is_full().then_some(())?;
        let version = state.phase.version;
        self.drop_waiting(state, Reason::Stale, |header| self.is_stale(header, version));
        state.next.take_if(|next| next.is_full())
    }

    fn is_stale(&self, header: &UnrollHeader, version: u64) -> bool {
        version.saturating_sub(header.version) > self.inner.config.max_staleness
    }

    /// Whether there can be a slot for an unroll of this environment.
    fn has_room_for(&self, state: &State, header: &UnrollHeader) -> bool {
        let BatchOrder::Environment = self.inner.config.order else { return true };
        let environment = header.environment as usize;
        let waiting = [&state.next, &state.open].into_iter().flatten();
        environment < self.inner.config.unrolls
            && waiting.filter(|batch| !batch.is_full()).all(|batch| batch.is_free(environment))
    }

    /// Moves buffers on: a filled open batch becomes the next one when there is none, and a free buffer the open one.
    fn settle(&self, state: &mut State) {
        if state.next.is_none() {
            state.next = state.open.take_if(|open| open.is_full());
        }
        if state.next.as_ref().is_some_and(Buffer::is_full) {
            self.inner.filled.notify_one();
        }
        if state.open.is_none()
            && let Some(buffer) = state.free.pop()
        {
            state.open = Some(buffer);
            self.inner.slots.add_permits(self.inner.config.unrolls);
        }
    }
}

impl State {
    /// Tasks of the unrolls that wait for the trainer.
    fn waiting(&self) -> impl Iterator<Item = u32> {
        [&self.next, &self.open].into_iter().flatten().flat_map(Buffer::tasks)
    }
}

fn refuse_unaccountable(ledger: &mut Ledger, header: &UnrollHeader) -> Option<Outcome> {
    match ledger.sight(header.actor, header.incarnation, header.sequence) {
        Sighting::New => None,
        Sighting::Duplicate => {
            ledger.repeat();
            Some(Outcome::Duplicate)
        }
        Sighting::Broken => {
            ledger.refuse();
            Some(Outcome::Invalid)
        }
        Sighting::Unknown => {
            ledger.refuse();
            Some(Outcome::NotJoined)
        }
    }
}

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
