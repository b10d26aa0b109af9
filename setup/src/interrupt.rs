//! Ctrl-C, SIGTERM and a closed terminal as a counter.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use anyhow::{Context, Result};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use signal_hook::low_level::emulate_default_handler;

/// How often this program has been asked to stop. While an `Interrupt` exists the signals are counted and do not kill.
/// After the last one is dropped they kill again.
#[derive(Clone, Default)]
pub struct Interrupt(Arc<AtomicUsize>);

/// What the process does with its signals. There is one thread that receives them, whatever the number of interrupts: each
/// signal goes to every thread that listens, and one without an interrupt would end the process.
struct Owner {
    listens: bool,
    /// The count of the interrupts that exist.
    count: Weak<AtomicUsize>,
}

static OWNER: Mutex<Owner> = Mutex::new(Owner { listens: false, count: Weak::new() });

fn owner() -> MutexGuard<'static, Owner> {
    OWNER.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Interrupt {
    /// Counts the signals from now on. Interrupts that exist at the same time have one count.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn install() -> Result<Self> {
        let mut owner = owner();
        if !owner.listens {
            let signals = Signals::new([SIGINT, SIGTERM, SIGHUP]).context("cannot handle signals")?;
            std::thread::spawn(move || listen(signals));
            owner.listens = true;
        }
        let count = owner.count.upgrade().unwrap_or_default();
        owner.count = Arc::downgrade(&count);
        Ok(Self(count))
    }

    /// Asks this program to stop, as a signal does.
    pub fn request(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    /// Requests to stop so far.
    pub fn count(&self) -> usize {
        self.0.load(Ordering::Relaxed)
    }

    /// Whether there was a request.
    pub fn requested(&self) -> bool {
        self.count() > 0
    }
}

fn listen(mut signals: Signals) {
    for signal in signals.forever() {
        let count = owner().count.upgrade();
        match count {
            Some(count) => drop(count.fetch_add(1, Ordering::Relaxed)),
            None => drop(emulate_default_handler(signal)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use signal_hook::low_level::raise;

    use super::*;

    #[test]
    fn an_interrupt_that_was_dropped_does_not_end_the_process_of_a_later_one() {
        drop(Interrupt::install().unwrap());
        let interrupt = Interrupt::install().unwrap();
        for number in 1..=20 {
            raise(SIGTERM).unwrap();
            let deadline = Instant::now() + Duration::from_secs(20);
            while interrupt.count() < number && Instant::now() < deadline {
                std::thread::yield_now();
            }
            assert_eq!(interrupt.count(), number, "a signal was lost");
        }
        assert_eq!(Interrupt::install().unwrap().count(), 20, "another one has another count");
    }
}
