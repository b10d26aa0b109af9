//! From validated unrolls to batches: each trained on at most once, bounded in memory, with accounting that balance.
//!
//! # Layout
//! - [`Batcher`] is the meeting point: network tasks [`insert`](Batcher::insert) unrolls, the trainer's thread takes
//!   [`Batch`]es and gives them back with [`trained`](Batcher::trained).
//! - [`Ledger`] knows every actor's account: which sequence number comes next, and what became of the earlier ones.
//! - [`Accounting`] are the sums, [`TaskAccounting`] those of one task; [`Snapshot`] is accounting and accounts in a checkpoint.
//!
//! # The rules
//! An actor process is an *incarnation*, a number it draws once. Joining opens an account, `(actor index, incarnation,
//! next sequence)`. An index belongs to one incarnation for ever; it is never given out twice.
//!
//! 1. An unroll numbered below the account's next sequence is a **duplicate**: counted, and nothing else happens.
//! 2. Any other unroll that the batcher decides about moves the account to one past its number, so *produced* is the
//!    sum of all accounts, open and closed. The numbers it skips were lost with an earlier life of the learner and are
//!    dropped as **lost at restart**.
//!    An actor that joins says how far it was acknowledged, and the account moves there in the same way.
//! 3. The unroll itself is either dropped for a reason — **invalid**; **superseded**, made in another epoch or in
//!    another phase (each behaviour is a phase); **stale**, made with parameters more than `max_staleness`
//!    published versions old — or it is copied into a slot of the open batch and is then *in flight*. Where slots are
//!    the environments' ([`BatchOrder::Environment`]), one whose environment has no slot, or has filled it, is invalid.
//! 4. An unroll in flight ends in one way: its batch is trained on, or it is dropped. A change of phase drops what waits
//!    in the batcher as superseded. What grew too old while it waited is dropped as stale when its batch is due, and the
//!    batch is handed out when its slots are filled again. A batch that its taker lets go of without training is lost
//!    at restart.
//! 5. While an unroll waits for a slot nothing is recorded. Dropping the waiting future leaves no trace, and the
//!    rules are applied at the moment the slot is there: another copy may have been faster.
//! 6. Restoring a [`Snapshot`] counts what was in flight in it as lost at restart, and leaves the accounts as they
//!    were: an unroll numbered below the account's next sequence is never trained on again.
//! 7. At most [`Ledger::CAPACITY`] accounts are open. One more closes the account heard of least recently: its sums
//!    stay in the accounting, and its incarnation cannot come back (joining is refused, a new process gets a new account).
//! 8. What cannot be attributed to an account is refused and counted apart, like duplicates: it is nobody's number.
//!
//! # Invariants
//! - `produced = trained + dropped + in flight` whenever anyone looks; *in flight* is counted in the buffers, not
//!   computed from the others. The same holds of every task's own accounting. An unroll belongs to the task that its
//!   header names; an unroll that is invalid, or of another epoch, counts for no task.
//! - Memory is [`Config::ahead`] batches and the one at the trainer, whatever the number of actors.
//! - No unroll is in two batches, or twice in one.

mod batch;
mod batcher;
mod ledger;
mod snapshot;
mod streaming;
mod tasks;

pub use batch::Batch;
pub use batcher::{BatchOrder, Batcher, Config, Next, Outcome, Phase};
pub use ledger::{Accounting, Dropped, JoinError, Joined, Ledger, Reason};
pub use snapshot::{Account, Error, Snapshot};
pub use tasks::{AccountingByTask, TaskAccounting};
