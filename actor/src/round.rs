//! A worker's last unrolls, until the learner has answered for each of them.
//!
//! A worker begins new unrolls only then. That is the back-pressure of the whole system: what waits at an actor is one
//! round of unrolls a thread, and experience is no older than it has to be.

use std::sync::Arc;

use parking_lot::{Condvar, Mutex};

/// Counts the tickets that are out.
#[derive(Debug, Default)]
pub struct Round {
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    out: Mutex<usize>,
    returned: Condvar,
}

/// Goes with an unroll and comes back when it is dropped: acknowledged, or given up with the connection.
#[derive(Debug)]
pub struct Ticket {
    shared: Arc<Shared>,
}

impl Round {
    /// A ticket of this round.
    pub fn ticket(&self) -> Arc<Ticket> {
        *self.shared.out.lock() += 1;
        Arc::new(Ticket { shared: Arc::clone(&self.shared) })
    }

    /// Waits until every ticket is back.
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
    fn a_round_is_over_when_every_ticket_is_back() {
        let round = Round::default();
        let tickets = [round.ticket(), round.ticket()];
        let dropper = std::thread::spawn(move || drop(tickets));
        round.wait();
        dropper.join().unwrap();
        assert_eq!(*round.shared.out.lock(), 0);
    }
}
