//! Waits until the learner has answered for each of a worker's last unrolls.
//!
//! A worker begins new unrolls only after that. This is the back-pressure of the whole system: at most one round of unrolls
//! a thread waits at an actor, and unrolls stay as fresh as possible.

use std::sync::Arc;

use parking_lot::{Condvar, Mutex};

/// Counts the tickets that are not returned yet.
#[derive(Debug, Default)]
pub struct Round {
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    out: Mutex<usize>,
    returned: Condvar,
}

/// Belongs to an unroll. Dropping it returns it: the unroll is acknowledged, or the session has ended.
#[derive(Debug)]
pub struct Ticket {
    shared: Arc<Shared>,
}

impl Round {
    /// A new ticket of this round.
    pub fn ticket(&self) -> Arc<Ticket> {
        *self.shared.out.lock() += 1;
        Arc::new(Ticket { shared: Arc::clone(&self.shared) })
    }

    /// Waits until every ticket is returned.
    pub fn wait(&self) {
        let mut out = self.shared.out.lock();
        while *out > 0 {
            self.shared.returned.wait(&mut out);
        }
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        *self.shared.out.lock() -= 1;
        self.shared.returned.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_round_is_over_when_every_ticket_is_returned() {
        let round = Round::default();
        let tickets = [round.ticket(), round.ticket()];
        let dropper = std::thread::spawn(move || drop(tickets));
        round.wait();
        dropper.join().unwrap();
        assert_eq!(*round.shared.out.lock(), 0);
    }
}
