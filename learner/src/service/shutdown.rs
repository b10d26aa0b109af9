//! How the service ends: first it drains, then it closes.

use tokio::sync::watch;
use tonic::Status;

use crate::publish::Publisher;

/// The state of the service's end; a handle that can be cloned.
///
/// A service that drains takes no new actors and reports that it does not serve. A service that closes also ends its streams.
#[derive(Clone, Debug)]
pub(super) struct Shutdown {
    draining: watch::Sender<bool>,
    closing: watch::Sender<bool>,
    publisher: Publisher,
}

impl Shutdown {
    /// A service that neither drains nor closes, with these parameters.
    pub(super) fn new(publisher: Publisher) -> Self {
        Self { draining: watch::Sender::new(false), closing: watch::Sender::new(false), publisher }
    }

    pub(super) fn drain(&self) {
        self.draining.send_replace(true);
    }

    pub(super) fn close(&self) {
        self.closing.send_replace(true);
    }

    /// Whether the service drains or closes.
    pub(super) fn has_begun(&self) -> bool {
        *self.draining.borrow() || *self.closing.borrow()
    }

    pub(super) fn draining(&self) -> Signal {
        Signal(self.draining.subscribe())
    }

    pub(super) fn closing(&self) -> Signal {
        Signal(self.closing.subscribe())
    }

    /// Whether actors are told that the run is over.
    pub(super) fn run_is_over(&self) -> bool {
        self.publisher.run_is_over()
    }

    /// The status with which a stream ends when the service closes: `None` when the run is over, because then the parameters
    /// have told the actor so.
    pub(super) fn status(&self) -> Option<Status> {
        (!self.run_is_over()).then(|| Status::unavailable("the learner is draining: reconnect"))
    }
}

/// A signal of a [`Shutdown`].
#[derive(Clone, Debug)]
pub(super) struct Signal(watch::Receiver<bool>);

impl Signal {
    /// Waits for the signal. Cancel-safe.
    pub(super) async fn given(&mut self) {
        // An error means that the service is gone, and the server with it.
        let _ = self.0.wait_for(|given| *given).await;
    }

    pub(super) fn is_given(&self) -> bool {
        *self.0.borrow()
    }
}
