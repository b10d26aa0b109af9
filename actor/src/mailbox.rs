//! The newest directive of the learner, kept for the workers.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::Bytes;
use comic_proto::v1::Behaviour;
use parking_lot::{Condvar, Mutex, MutexGuard};

/// One version of how to act; a version means nothing without its learner epoch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Directive {
    /// Which life of the learner published it.
    pub learner_epoch: u64,
    /// Its version within that life.
    pub version: u64,
    /// How to act with it.
    pub behaviour: Behaviour,
    /// The acting parameters (safetensors); may be empty for a demonstration.
    pub parameters: Bytes,
}

/// Holds one directive, always the newest: a slow worker skips the ones in between. Closing it stops the workers.
#[derive(Debug, Default)]
pub struct Mailbox {
    state: Mutex<State>,
    changed: Condvar,
    closed: AtomicBool,
}

#[derive(Debug, Default)]
struct State {
    newest: Option<Arc<Directive>>,
    /// Learner epoch and version that are known to be out, though they may still be on their way.
    announced: (u64, u64),
}

impl Mailbox {
    /// Replaces the directive.
    pub fn publish(&self, directive: Directive) {
        self.lock().newest = Some(Arc::new(directive));
        self.changed.notify_all();
    }

    /// A new connection: what was announced on the last one may never come.
    pub fn reconnected(&self) {
        self.lock().announced = (0, 0);
        self.changed.notify_all();
    }

    /// Says that this version is out: nobody gets an older directive from now on.
    pub fn announce(&self, learner_epoch: u64, version: u64) {
        let mut state = self.lock();
        state.announced = state.announced.max((learner_epoch, version));
    }

    /// The newest directive, waiting for the one that was announced; `None` once the mailbox is closed.
    pub fn wait(&self) -> Option<Arc<Directive>> {
        self.wait_from((0, 0))
    }

    /// The same, waiting for one that is at least of this learner epoch and version too.
    pub fn wait_from(&self, oldest: (u64, u64)) -> Option<Arc<Directive>> {
        let mut state = self.lock();
        loop {
            if self.is_closed() {
                return None;
            }
            match &state.newest {
                Some(directive) if (directive.learner_epoch, directive.version) >= state.announced.max(oldest) => {
                    return Some(Arc::clone(directive));
                }
                _ => self.changed.wait(&mut state),
            }
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock()
    }

    /// Tells the workers to stop after the step they are in.
    pub fn close(&self) {
        // Under the lock, or a waiter between its check and its wait would sleep for ever.
        let _state = self.lock();
        self.closed.store(true, Ordering::Release);
        self.changed.notify_all();
    }

    /// Whether the workers were told to stop.
    pub fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn directive(version: u64) -> Directive {
        Directive { learner_epoch: 1, version, behaviour: Behaviour::Policy, parameters: Bytes::new() }
    }

    #[test]
    fn a_slow_worker_skips_versions() {
        let mailbox = Mailbox::default();
        mailbox.publish(directive(1));
        mailbox.publish(directive(2));
        assert_eq!(mailbox.wait().unwrap().version, 2);
        assert_eq!(mailbox.wait().unwrap().version, 2);
    }

    #[test]
    fn nobody_gets_an_older_directive_than_was_announced() {
        let mailbox = Arc::new(Mailbox::default());
        mailbox.publish(directive(1));
        mailbox.announce(1, 2);
        let waiter = std::thread::spawn({
            let mailbox = Arc::clone(&mailbox);
            move || mailbox.wait().unwrap().version
        });
        mailbox.publish(directive(2));
        assert_eq!(waiter.join().unwrap(), 2);
    }

    #[test]
    fn who_wants_a_newer_directive_waits_for_it() {
        let mailbox = Arc::new(Mailbox::default());
        mailbox.publish(directive(1));
        let waiter = std::thread::spawn({
            let mailbox = Arc::clone(&mailbox);
            move || mailbox.wait_from((1, 2)).unwrap().version
        });
        mailbox.publish(directive(2));
        assert_eq!(waiter.join().unwrap(), 2);
    }

    #[test]
    fn closing_wakes_a_worker_that_waits_for_the_first_directive() {
        let mailbox = Arc::new(Mailbox::default());
        let waiter = std::thread::spawn({
            let mailbox = Arc::clone(&mailbox);
            move || mailbox.wait()
        });
        mailbox.close();
        assert!(waiter.join().unwrap().is_none());
    }
}
