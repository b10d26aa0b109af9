//! The identity of a simulated actor, and its unrolls without an acknowledgement. Both last over lost connections.

use std::collections::VecDeque;

use anyhow::{Context as _, Result};
use bytes::Bytes;
use comic_proto::v1::{JoinReply, UnrollAck, UnrollHeader, UnrollMessage};
use tokio::sync::mpsc;

/// One incarnation of an actor.
#[derive(Debug)]
pub(super) struct Identity {
    /// The index that the learner assigned.
    pub(super) actor: Option<u64>,
    pub(super) incarnation: u64,
    next_sequence: u64,
    /// Headers of the unrolls in flight.
    waiting: VecDeque<UnrollHeader>,
}

impl Identity {
    /// A new incarnation, with the index of the last one if there was one.
    pub(super) fn new(actor: Option<u64>) -> Self {
        Self { actor, incarnation: rand::random(), next_sequence: 0, waiting: VecDeque::new() }
    }

    /// Sends the unrolls again that were in flight when the last connection was lost, unchanged.
    pub(super) fn send_again(
        &self,
        up: &mpsc::Sender<UnrollMessage>,
        reply: &JoinReply,
        payload: &Bytes,
    ) -> Result<()> {
        let readdressed = |header: &UnrollHeader| UnrollHeader { actor: reply.actor, ..header.clone() };
        self.waiting.iter().try_for_each(|header| send(up, readdressed(header), payload))
    }

    /// Sends unrolls of `version` until `window` of them are in flight.
    pub(super) fn fill(
        &mut self,
        up: &mpsc::Sender<UnrollMessage>,
        reply: &JoinReply,
        (payload, layout_hash): &(Bytes, Vec<u8>),
        window: usize,
        version: u64,
    ) -> Result<()> {
        while self.waiting.len() < window {
            let header = UnrollHeader {
                actor: reply.actor,
                incarnation: self.incarnation,
                sequence: self.next_sequence,
                learner_epoch: reply.learner_epoch,
                version,
                layout_hash: layout_hash.clone(),
                ..UnrollHeader::default()
            };
            self.next_sequence += 1;
            self.waiting.push_back(header.clone());
            send(up, header, payload)?;
        }
        Ok(())
    }

    /// Removes an acknowledged unroll from those in flight.
    pub(super) fn settle(&mut self, ack: &UnrollAck) {
        self.waiting.retain(|header| header.sequence != ack.sequence);
    }
}

/// The channel has room for every unroll in flight, so it refuses only when the connection is lost.
fn send(up: &mpsc::Sender<UnrollMessage>, header: UnrollHeader, payload: &Bytes) -> Result<()> {
    let message = UnrollMessage { header: Some(header), payload: payload.clone() };
    up.try_send(message).context("the stream of unrolls is lost")
}
