//! Holds the learner's newest directive for the workers.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::Bytes;
use parking_lot::{Condvar, Mutex, MutexGuard};

/// How to act, in one version. Versions of different learner epochs cannot be compared.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Directive {
    /// The learner epoch that published it.
    pub learner_epoch: u64,
    /// Its version within that epoch.
    pub version: u64,
    /// The parameters of the policy (safetensors).
    pub parameters: Bytes,
}

/// Holds only the newest directive: a slow worker skips the ones in between. Closing it stops the workers.
#[derive(Debug, Default)]
pub struct Mailbox {
    state: Mutex<State>,
    changed: Condvar,
    closed: AtomicBool,
}

#[derive(Debug, Default)]
struct State {
    newest: Option<Arc<Directive>>,
    /// Newest learner epoch and version that the learner has announced; the parameters may still be on their way.
    announced: (u64, u64),
}

impl Mailbox {
    /// Replaces the directive.
    pub fn publish(&self, directive: Directive) {
        self.lock().newest = Some(Arc::new(directive));
        self.changed.notify_all();
    }

    /// Forgets announcements at a new connection: parameters announced on the last one may never arrive.
    pub fn reconnected(&self) {
        self.lock().announced = (0, 0);
        self.changed.notify_all();
    }

    /// Notes that the learner has published this version. From now on no older directive is returned.
    pub fn announce(&self, learner_epoch: u64, version: u64) {
        let mut state = self.lock();
        state.announced = state.announced.max((learner_epoch, version));
    }

    /// Returns the newest directive, after waiting for the announced one; `None` once the mailbox is closed.
    pub fn wait(&self) -> Option<Arc<Directive>> {
        self.wait_from((0, 0))
    }

    /// As [`wait`](Self::wait), but waits for at least this learner epoch and version.
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
        // The lock is needed: a waiter between its check and its wait would sleep for ever.
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
        Directive { learner_epoch: 1, version, parameters: Bytes::new() }
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
    fn no_directive_older_than_the_announced_one_is_returned() {
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
    fn a_worker_can_wait_for_a_newer_directive() {
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
