//! `SendUnrolls`, from a decoded unroll to its acknowledgement.

use std::sync::Arc;
use std::time::Instant;

use comic_proto::v1::{UnrollAck, UnrollHeader, Verdict};
use comic_proto::{Expected, Invalid, Pieces, ReceivedUnroll, validate};
use comic_replay::{Batcher, Outcome};
use tonic::Status;
use tracing::{Instrument as _, Span};

use super::assignments::Assignments;
use super::quarantine::Quarantine;
use super::roster::{Roster, superseded};
use super::shutdown::Shutdown;
use crate::log_limiter::LogLimiter;
use crate::observe::prometheus::Prometheus;
use crate::publish::Publisher;

/// Validates unrolls and puts them into batches.
#[derive(Debug)]
pub(super) struct Intake {
    pub(super) batcher: Batcher,
    pub(super) publisher: Publisher,
    /// Number of clips of each task.
    pub(super) clips: Vec<usize>,
    pub(super) roster: Arc<Roster>,
    /// Only in lockstep.
    pub(super) assignments: Option<Arc<Assignments>>,
    pub(super) quarantine: Option<Quarantine>,
    pub(super) shutdown: Shutdown,
    pub(super) prometheus: Arc<Prometheus>,
    /// By actor.
    pub(super) log_limiter: LogLimiter<u64>,
}

impl Intake {
    /// Validates an unroll, puts it into a batch, and answers it when it has its place there. `None` when the run is over.
    ///
    /// # Errors
    /// The status that ends the actor's stream.
    pub(super) async fn take(&self, unroll: ReceivedUnroll) -> Result<Option<UnrollAck>, Status> {
        let span = span(unroll.header.as_ref());
        self.take_in_span(unroll).instrument(span).await
    }

    /// Counts a message that cannot be decoded, whose actor is therefore not known.
    pub(super) fn refuse_malformed(&self, reason: &Status) {
        self.batcher.refuse_unattributed();
        tracing::warn!(reason = reason.message(), "unroll stream ended: not a message of this protocol");
    }

    async fn take_in_span(&self, unroll: ReceivedUnroll) -> Result<Option<UnrollAck>, Status> {
        let ReceivedUnroll { header, payload } = unroll;
        let Some(header) = header else {
            self.batcher.refuse_unattributed();
            return Ok(Some(self.ack(0, Verdict::Invalid, Invalid::Header.to_string())));
        };
        self.prometheus.unroll_bytes.observe(payload.len() as f64);
        self.check_sender(&header)?;
        match self.check(&header, &payload) {
            Ok(()) => {
                let _waiting = self.roster.begin_waiting(header.incarnation);
                let insertion = self.batcher.insert(&header, payload).instrument(tracing::debug_span!("insert"));
                let outcome = insertion.await;
                let reason =
                    "its sequence number does not fit its account, or its environment has no place in the batch";
                self.answer(&header, outcome, || reason.into())
            }
            Err(invalid) => {
                let outcome = self.batcher.refuse_invalid(&header);
                if let (Outcome::Invalid, Some(quarantine)) = (outcome, &self.quarantine) {
                    quarantine.offer(&header, &payload, &invalid);
                }
                self.answer(&header, outcome, || invalid.to_string())
            }
        }
    }

    /// Notes that the actor is there, and checks that it may send this unroll.
    fn check_sender(&self, header: &UnrollHeader) -> Result<(), Status> {
        if !self.roster.heard(header.incarnation, Instant::now()) {
            return Err(superseded());
        }
        if let Some(assignments) = &self.assignments
            && !assignments.owns(header.incarnation, header.environment)
        {
            let environment = header.environment;
            let status = format!("in lockstep environment {environment} is not assigned to this actor");
            return Err(Status::failed_precondition(status));
        }
        Ok(())
    }

    fn check(&self, header: &UnrollHeader, payload: &Pieces) -> Result<(), Invalid> {
        let expected = Expected {
            clips: &self.clips,
            epoch: self.publisher.epoch(),
            newest_version: self.publisher.newest_version(),
        };
        // An unroll of an earlier learner epoch may have another layout. It is superseded, whatever it holds.
        if header.learner_epoch < expected.epoch {
            return Ok(());
        }
        let validation = || validate(self.batcher.layout(), header, payload, &expected);
        tracing::debug_span!("validate").in_scope(validation)
    }

    /// The acknowledgement of an unroll that the batcher answered so; `invalid` says why it is invalid.
    fn answer(
        &self,
        header: &UnrollHeader,
        outcome: Outcome,
        invalid: impl FnOnce() -> String,
    ) -> Result<Option<UnrollAck>, Status> {
        let (verdict, detail) = match outcome {
            Outcome::Taken => (Verdict::Taken, String::new()),
            Outcome::Duplicate => (Verdict::Duplicate, String::new()),
            Outcome::Superseded => self.superseded(header),
            Outcome::Stale => {
                let newest = self.batcher.phase().version;
                (Verdict::Stale, format!("version {} is too old, the newest is {newest}", header.version))
            }
            Outcome::Invalid => {
                let (actor, sequence, reason) = (header.actor, header.sequence, invalid());
                if let Some(unreported) = self.log_limiter.due(actor) {
                    tracing::warn!(actor, sequence, unreported, "invalid unroll refused: {reason}");
                }
                (Verdict::Invalid, reason)
            }
            Outcome::NotJoined => {
                return Err(Status::failed_precondition(format!(
                    "actor {}, incarnation {:016x}, has no account with this learner: join first",
                    header.actor, header.incarnation
                )));
            }
            Outcome::Closed => return self.shutdown.status().map_or(Ok(None), Err),
        };
        Ok(Some(self.ack(header.sequence, verdict, detail)))
    }

    fn superseded(&self, header: &UnrollHeader) -> (Verdict, String) {
        let epoch = self.publisher.epoch();
        if header.learner_epoch != epoch {
            return (Verdict::Rejoin, format!("made in learner epoch {}, this is {epoch}", header.learner_epoch));
        }
        let (version, oldest) = (header.version, self.batcher.phase().oldest);
        (Verdict::Superseded, format!("version {version} is of an earlier phase, which ended before version {oldest}"))
    }

    fn ack(&self, sequence: u64, verdict: Verdict, detail: String) -> UnrollAck {
        let (learner_epoch, version) = (self.publisher.epoch(), self.publisher.newest_version());
        UnrollAck { sequence, verdict: verdict.into(), detail, learner_epoch, version }
    }
}

/// Names an unroll in every log. The actor's log has the same incarnation and sequence number.
fn span(header: Option<&UnrollHeader>) -> Span {
    let Some(UnrollHeader { actor, incarnation, sequence, version, .. }) = header else { return Span::none() };
    tracing::debug_span!("unroll", actor, incarnation = format_args!("{incarnation:016x}"), sequence, version)
}
