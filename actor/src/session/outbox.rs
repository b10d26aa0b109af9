//! Unrolls without the learner's acknowledgement.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use comic_proto::v1::{UnrollAck, UnrollHeader, UnrollMessage, Verdict};
use tracing::Span;

use crate::worker::FinishedUnroll;

/// A refusal is logged at most once in this time.
const REFUSAL_LOG: Duration = Duration::from_secs(60);

/// How the learner answered: numbers of unrolls, and whether the run is over.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Settled {
    /// Taken into a batch.
    pub taken: u64,
    /// The learner had the unroll already; only its acknowledgement was lost.
    pub duplicate: u64,
    /// Too old, or made in an earlier learner epoch or phase.
    pub stale: u64,
    /// Refused as invalid, or with a verdict this actor does not know.
    pub invalid: u64,
    /// Whether the learner said that the run is over.
    pub over: bool,
}

/// An unroll with a sequence number and without an answer.
#[derive(Debug)]
struct Waiting {
    sequence: u64,
    unroll: FinishedUnroll,
    /// From the sequence number to the answer, or to the session's end. The learner's log has the same incarnation and
    /// sequence number; the actor's index may change when the learner restarts.
    span: Span,
}

/// A bounded queue in the order of sequence numbers; the first `sent` unrolls were sent on the current connection.
#[derive(Debug)]
pub(super) struct Outbox {
    window: usize,
    layout_hash: Vec<u8>,
    waiting: VecDeque<Waiting>,
    sent: usize,
    next_sequence: u64,
    settled: Settled,
    refusal_logged: Option<Instant>,
}

impl Outbox {
    pub(super) fn new(window: usize, layout_hash: [u8; 32]) -> Self {
        Self {
            window: window.max(1),
            layout_hash: layout_hash.to_vec(),
            waiting: VecDeque::new(),
            sent: 0,
            next_sequence: 0,
            settled: Settled::default(),
            refusal_logged: None,
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    pub(super) fn len(&self) -> usize {
        self.waiting.len()
    }

    pub(super) fn has_room(&self) -> bool {
        self.waiting.len() < self.window
    }

    pub(super) fn has_unsent(&self) -> bool {
        self.sent < self.waiting.len()
    }

    pub(super) fn settled(&self) -> Settled {
        self.settled
    }

    /// The sequence number below which every unroll is acknowledged.
    pub(super) fn acknowledged(&self) -> u64 {
        self.waiting.front().map_or(self.next_sequence, |waiting| waiting.sequence)
    }

    /// At a new connection: all waiting unrolls are sent again.
    pub(super) fn rewind(&mut self) {
        self.sent = 0;
    }

    /// Adds an unroll and gives it its sequence number.
    pub(super) fn push(&mut self, unroll: FinishedUnroll, incarnation: u64) {
        let (sequence, version, environment) = (self.next_sequence, unroll.version, unroll.environment);
        let incarnation = format_args!("{incarnation:016x}");
        let span = tracing::debug_span!("unroll", incarnation, sequence, version, environment);
        span.in_scope(|| tracing::debug!("made"));
        self.waiting.push_back(Waiting { sequence, unroll, span });
        self.next_sequence += 1;
    }

    /// The message of the next unroll to send, if there is one.
    pub(super) fn send(&mut self, actor: u64, incarnation: u64) -> Option<UnrollMessage> {
        let Waiting { sequence, unroll, span } = self.waiting.get(self.sent)?;
        self.sent += 1;
        let header = UnrollHeader {
            actor,
            incarnation,
            sequence: *sequence,
            learner_epoch: unroll.learner_epoch,
            version: unroll.version,
            layout_hash: self.layout_hash.clone(),
            episodes: unroll.episodes.clone(),
            environment: unroll.environment,
            task: unroll.task,
        };
        span.in_scope(|| tracing::debug!(actor, "sent"));
        Some(UnrollMessage { header: Some(header), payload: unroll.payload.clone() })
    }

    /// Removes an acknowledged unroll, whatever the verdict: a refused unroll would be refused again.
    pub(super) fn settle(&mut self, ack: &UnrollAck) {
        let Ok(place) = self.waiting.binary_search_by_key(&ack.sequence, |waiting| waiting.sequence) else {
            tracing::debug!(sequence = ack.sequence, "an acknowledgement of an unroll that does not wait for one");
            return;
        };
        if place >= self.sent {
            tracing::warn!(sequence = ack.sequence, "an acknowledgement of an unroll that was not sent");
            return;
        }
        if let Some(waiting) = self.waiting.remove(place) {
            waiting.span.in_scope(|| tracing::debug!(verdict = ?ack.verdict(), "acknowledged"));
        }
        self.sent -= 1;
        match Verdict::try_from(ack.verdict) {
            Ok(Verdict::Taken) => self.settled.taken += 1,
            Ok(Verdict::Duplicate) => self.settled.duplicate += 1,
            Ok(Verdict::Stale | Verdict::Superseded | Verdict::Rejoin) => self.settled.stale += 1,
            Ok(Verdict::Invalid | Verdict::Unspecified) | Err(_) => {
                self.settled.invalid += 1;
                self.log_refusal(ack);
            }
        }
    }

    fn log_refusal(&mut self, ack: &UnrollAck) {
        if self.refusal_logged.is_none_or(|last| last.elapsed() >= REFUSAL_LOG) {
            self.refusal_logged = Some(Instant::now());
            let (sequence, refused) = (ack.sequence, self.settled.invalid);
            tracing::warn!(sequence, refused, "the learner refused an unroll: {}", ack.detail);
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    fn unroll() -> FinishedUnroll {
        FinishedUnroll {
            payload: Bytes::new(),
            learner_epoch: 1,
            version: 1,
            episodes: Vec::new(),
            environment: 0,
            task: 0,
            ticket: None,
        }
    }

    fn ack(sequence: u64, verdict: Verdict) -> UnrollAck {
        UnrollAck { sequence, verdict: verdict.into(), ..UnrollAck::default() }
    }

    fn sent(outbox: &mut Outbox) -> Vec<u64> {
        std::iter::from_fn(|| outbox.send(0, 0)).map(|message| message.header.unwrap().sequence).collect()
    }

    #[test]
    fn unrolls_without_acknowledgement_are_sent_again_in_order() {
        let mut outbox = Outbox::new(8, [0; 32]);
        (0..4).for_each(|_| outbox.push(unroll(), 0));
        assert_eq!(sent(&mut outbox), [0, 1, 2, 3]);
        outbox.settle(&ack(1, Verdict::Taken));
        outbox.settle(&ack(0, Verdict::Stale));
        outbox.push(unroll(), 0);
        outbox.rewind();
        assert_eq!(sent(&mut outbox), [2, 3, 4]);
        outbox.settle(&ack(2, Verdict::Duplicate));
        assert_eq!(outbox.settled(), Settled { taken: 1, duplicate: 1, stale: 1, ..Settled::default() });
    }

    #[test]
    fn acknowledgements_of_unknown_and_unsent_unrolls_change_nothing() {
        let mut outbox = Outbox::new(2, [0; 32]);
        outbox.push(unroll(), 0);
        outbox.settle(&ack(0, Verdict::Taken));
        outbox.settle(&ack(7, Verdict::Taken));
        assert_eq!(outbox.settled(), Settled::default());
        assert_eq!(sent(&mut outbox), [0]);
    }

    #[test]
    fn the_window_bounds_the_queue() {
        let mut outbox = Outbox::new(2, [0; 32]);
        (0..2).for_each(|_| outbox.push(unroll(), 0));
        assert!(!outbox.has_room());
        sent(&mut outbox);
        outbox.settle(&ack(0, Verdict::Taken));
        assert!(outbox.has_room());
    }
}
