//! From validated unrolls to batches. Each unroll is trained on at most once, memory is bounded, and the accounting
//! balances.
//!
//! # Layout
//! - [`Batcher`] connects service and trainer: the service's async tasks [`insert`](Batcher::insert) unrolls; the
//!   trainer's thread takes [`Batch`]es and returns them with [`trained`](Batcher::trained). On-policy learning takes
//!   full batches ([`next_batch_within`](Batcher::next_batch_within)), off-policy learning what is there
//!   ([`next_available_within`](Batcher::next_available_within)).
//! - [`Unrolls`] are arrays of unrolls: those of a batch, of a table, of a sample.
//! - [`Ledger`] has the account of every actor (its next sequence number) and the sums.
//! - [`Accounting`] has the sums, [`TaskAccounting`] those of one task. [`LedgerSnapshot`] is the ledger in a
//!   checkpoint.
//! - [`Table`] is the replay of off-policy learning: the trainer inserts the unrolls of batches and draws a [`Sample`]
//!   for each gradient step. [`RateLimiter`] says when. Both have the names and rules of Reverb.
//!
//! # The rules
//! An actor process is an *incarnation*: a random number that it draws once. Joining opens an account, `(actor index,
//! incarnation, next sequence)`. An index belongs to one incarnation for ever and is never assigned again.
//!
//! 1. An unroll with a number below the account's next sequence is a **duplicate**: it is counted, and nothing else
//!    happens.
//! 2. Every other unroll that the batcher accepts or drops moves the account to the number after its own. So *produced*
//!    is the sum of all accounts, open and closed. Skipped numbers were lost with an earlier learner epoch; they are
//!    dropped as **lost at restart**. An actor that joins sends the number up to which it was acknowledged, and the
//!    account moves there in the same way.
//! 3. The unroll is either dropped or copied into a slot of the open batch; then it is *in flight*. The reasons to drop
//!    it are **invalid**; **superseded**: made in another epoch or in an earlier phase; **stale**: made
//!    with parameters that are more than `max_staleness` published versions old. If each environment has its own slot
//!    ([`BatchOrder::Environment`]), an unroll is invalid if its environment has no slot or a full one.
//! 4. An unroll in flight ends in one way: its batch is trained on, or it is dropped. A change of phase drops the
//!    unrolls that wait in the batcher as superseded. Unrolls that became too old while they waited are dropped as
//!    stale when the trainer asks for them; a full batch is given when its slots are filled again. The unrolls of a
//!    batch that is dropped without training are lost at restart.
//! 5. Nothing is recorded while an unroll waits for a slot, so the waiting future can be dropped. The rules are applied
//!    again when a slot is free, because another copy may have been inserted in the meantime.
//! 6. Restoring a [`LedgerSnapshot`] counts its unrolls in flight as lost at restart and keeps the accounts. So an
//!    unroll with a number below the account's next sequence is never trained on again.
//! 7. At most [`Ledger::CAPACITY`] accounts are open. A further one closes the account with the oldest activity. Its
//!    sums stay in the accounting, and its incarnation is refused when it joins again. A new process gets a new
//!    account.
//! 8. A message without an account is refused. It is counted separately, like a duplicate, because its number belongs
//!    to no account.
//!
//! # The rules of table and rate limiter
//! 1. An item is an unroll. At [`TableConfig::max_size`] items, each insert *evicts* the oldest item. Memory is
//!    allocated and committed when the table is made.
//! 2. In a sample each item of the table is equally likely and comes at most once. The *age* of an item is the number
//!    of later inserts.
//! 3. The rate limiter keeps *sampled* near *samples per insert* · *inserted*, up to an *error buffer*. Inserts and
//!    samples never wait for each other.
//! 4. A table is saved with its items and counts ([`Table::write_to`]). The one that is read gives the same samples.
//!
//! A batch is trained on at most once, but its unrolls may be sampled from a table any number of times. For the
//! accounting they are trained on when their batch is.
//!
//! # Invariants
//! - `produced = trained + dropped + in flight` at any time. *In flight* is counted in the buffers and not computed
//!   from the other sums. The same holds for the accounting of every task. An unroll belongs to the task that its
//!   header names; an unroll that is invalid or of another epoch counts for no task.
//! - Memory is one batch for the trainer and [`Config::ahead`] more, for any number of actors. One more is for what is
//!   available: it is copied there, so the slots are free at once. The system commits it when it is first used.
//! - The unrolls that are given as available are the oldest, in the order in which they arrived.
//! - No unroll is in two batches, or twice in one batch.

mod accounting;
mod batch;
mod batcher;
mod buffer;
mod config;
mod ledger;
mod next;
mod phase;
mod rate_limiter;
mod snapshot;

mod table;
mod tasks;
mod uncached_copy;
mod unrolls;

pub use accounting::{Accounting, AccountingByTask, Dropped, Reason, TaskAccounting};
pub use batch::Batch;
pub use batcher::{Batcher, Outcome};
pub use config::{BatchOrder, Config};
pub use ledger::{JoinError, Joined, Ledger, MOST_LOST, home};
pub use next::Next;
pub use phase::Phase;
pub use rate_limiter::{RateError, RateLimiter};
pub use snapshot::{Account, Error, LedgerSnapshot};
pub use table::{Counts, ReadTableError, Sample, Table, TableConfig, TableError};
pub use unrolls::Unrolls;
