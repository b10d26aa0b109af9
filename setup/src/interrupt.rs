//! Ctrl-C, SIGTERM and a closed terminal as a counter.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::{Context, Result};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use signal_hook::low_level::emulate_default_handler;

/// How often this program has been asked to stop. While an `Interrupt` exists the signals are counted and do not kill.
/// After the last clone is dropped they kill again.
#[derive(Clone, Default)]
pub struct Interrupt(Arc<AtomicUsize>);

impl Interrupt {
    /// Installs the signal handlers.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn install() -> Result<Self> {
        let count = Arc::new(AtomicUsize::new(0));
        let shared = Arc::downgrade(&count);
        let mut signals = Signals::new([SIGINT, SIGTERM, SIGHUP]).context("cannot handle signals")?;
        std::thread::spawn(move || {
            for signal in signals.forever() {
                match shared.upgrade() {
                    Some(count) => drop(count.fetch_add(1, Ordering::Relaxed)),
                    None => drop(emulate_default_handler(signal)),
                }
            }
        });
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
