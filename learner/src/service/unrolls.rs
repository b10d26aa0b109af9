//! Unrolls up, acknowledgements down.

use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use comic_proto::v1::{Behaviour, UnrollAck, UnrollHeader, Verdict};
use comic_proto::{Expected, Invalid, ReceivedUnroll, frame, validate};
use comic_replay::Outcome;
use tonic::Status;
use tonic::body::Body;
use tracing::{Instrument as _, Span};

use super::calls::superseded;
use super::messages::{Broken, Messages};
use super::{Closing, Shared};

/// One actor's stream. The next unroll is read when the acknowledgement of the last one is on its way, and that comes when
/// the unroll has a slot in a batch.
pub(super) struct UnrollStream {
    shared: Arc<Shared>,
    incoming: Messages,
    closing: Closing,
    over: bool,
}

impl UnrollStream {
    pub(super) fn new(shared: Arc<Shared>, request: Body) -> Self {
        let incoming = Messages::new(request, shared.message_limit, &shared.room);
        Self { closing: shared.closing(), shared, incoming, over: false }
    }

    /// Takes one unroll and answers it. `None` when the actor has no more, or the run is over; an unroll that was not
    /// answered when the server closes is the actor's to send again.
    pub(super) async fn next(mut self) -> Option<(Result<Bytes, Status>, Self)> {
        if self.over {
            return None;
        }
        let answer = tokio::select! {
            biased;
            () = self.closing.begun() => self.shared.parting().map(Err),
            // Giving this up half-way is safe: the batcher records nothing before it takes the unroll.
            answer = answer(&self.shared, &mut self.incoming) => answer,
        }?;
        self.over = answer.is_err();
        Some((answer.map(|ack| frame(&ack)), self))
    }
}

async fn answer(shared: &Shared, incoming: &mut Messages) -> Option<Result<UnrollAck, Status>> {
    // The room is the message's until its numbers are in a batch.
    let (received, _room) = match incoming.next().await {
        Ok(Some((message, room))) => {
            let received = ReceivedUnroll::decode(message);
            (received.map_err(|malformed| Status::internal(malformed.to_string())), room)
        }
        Ok(None) => return None,
        // A connection that broke costs nothing.
        Err(Broken::Connection(status)) => return Some(Err(status)),
        Err(Broken::Protocol(status)) => (Err(status), None),
    };
    match received {
        Ok(unroll) => {
            let span = span(unroll.header.as_ref());
            take(shared, unroll).instrument(span).await.transpose()
        }
        Err(status) => {
            shared.batcher.refuse_unattributed();
            tracing::warn!(reason = status.message(), "unroll stream ended: not a message of this protocol");
            Some(Err(status))
        }
    }
}

/// What an unroll is called in every log: its actor's has the same incarnation and sequence number.
fn span(header: Option<&UnrollHeader>) -> Span {
    let Some(UnrollHeader { actor, incarnation, sequence, version, .. }) = header else { return Span::none() };
    tracing::debug_span!("unroll", actor, incarnation = format_args!("{incarnation:016x}"), sequence, version)
}

/// Checks an unroll and puts it into a batch. `None` when the batcher is closed since the run is over.
async fn take(shared: &Shared, unroll: ReceivedUnroll) -> Result<Option<UnrollAck>, Status> {
    let ReceivedUnroll { header, payload } = unroll;
    let Some(header) = header else {
        shared.batcher.refuse_unattributed();
        return Ok(Some(ack(shared, 0, Verdict::Invalid, Invalid::Header.to_string())));
    };
    shared.telemetry.unroll_bytes.observe(payload.len() as f64);
    if !shared.roster.heard(header.incarnation, Instant::now()) {
        return Err(superseded());
    }
    if let Some(assignments) = &shared.assignments
        && !assignments.owns(header.incarnation, header.environment)
    {
        let environment = header.environment;
        return Err(Status::failed_precondition(format!("in lockstep environment {environment} is not this actor's")));
    }
    let expected = Expected {
        clips: &shared.clips,
        epoch: shared.publisher.epoch(),
        newest_version: shared.publisher.newest_version(),
    };
    // An unroll of an earlier life of the learner may have had another layout: it is superseded, whatever it holds.
    let earlier = header.learner_epoch < expected.epoch;
    let check = || validate(shared.batcher.layout(), &header, &payload, &expected);
    let valid = if earlier { Ok(()) } else { tracing::debug_span!("validate").in_scope(check) };
    let (outcome, invalid) = match valid {
        Ok(()) => {
            let _waiting = shared.roster.wait(header.incarnation);
            let insertion = shared.batcher.insert(&header, payload).instrument(tracing::debug_span!("insert"));
            (insertion.await, None)
        }
        Err(invalid) => {
            let outcome = shared.batcher.refuse_invalid(&header);
            if let (Outcome::Invalid, Some(quarantine)) = (outcome, &shared.quarantine) {
                quarantine.offer(&header, &payload, &invalid);
            }
            (outcome, Some(invalid))
        }
    };
    let sequence = header.sequence;
    Ok(Some(match outcome {
        Outcome::Taken => ack(shared, sequence, Verdict::Taken, String::new()),
        Outcome::Duplicate => ack(shared, sequence, Verdict::Duplicate, String::new()),
        Outcome::Superseded => {
            let (verdict, detail) = out_of_time(&header, shared);
            ack(shared, sequence, verdict, detail)
        }
        Outcome::Stale => {
            let newest = shared.batcher.phase().version;
            ack(
                shared,
                sequence,
                Verdict::Stale,
                format!("version {} is too old, the newest is {newest}", header.version),
            )
        }
        Outcome::Invalid => {
            let reason = invalid.map_or_else(
                || "its numbers fit no account, or its environment no slot of the batch".into(),
                |invalid| invalid.to_string(),
            );
            if let Some(unreported) = shared.log_limiter.due(header.actor) {
                tracing::warn!(actor = header.actor, sequence, unreported, "invalid unroll refused: {reason}");
            }
            ack(shared, sequence, Verdict::Invalid, reason)
        }
        Outcome::NotJoined => {
            return Err(Status::failed_precondition(format!(
                "actor {}, incarnation {:016x}, has no account with this learner: join first",
                header.actor, header.incarnation
            )));
        }
        Outcome::Closed => return shared.parting().map_or(Ok(None), Err),
    }))
}

fn out_of_time(header: &UnrollHeader, shared: &Shared) -> (Verdict, String) {
    let epoch = shared.publisher.epoch();
    if header.learner_epoch != epoch {
        return (Verdict::Rejoin, format!("made in learner epoch {}, this is {epoch}", header.learner_epoch));
    }
    let wanted = match shared.batcher.phase().behaviour {
        Behaviour::Demonstration => "demonstrations",
        Behaviour::Policy | Behaviour::Unspecified => "the policy's own unrolls",
    };
    (Verdict::Superseded, format!("the learner wants {wanted} now"))
}

fn ack(shared: &Shared, sequence: u64, verdict: Verdict, detail: String) -> UnrollAck {
    let (learner_epoch, version) = (shared.publisher.epoch(), shared.publisher.newest_version());
    UnrollAck { sequence, verdict: verdict.into(), detail, learner_epoch, version }
}
