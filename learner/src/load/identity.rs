//! Who an actor of the crowd is, and what it still answers for, across connections.

use std::collections::VecDeque;

use anyhow::{Context as _, Result};
use bytes::Bytes;
use comic_proto::v1::{Behaviour, JoinReply, UnrollAck, UnrollHeader, UnrollMessage};
use tokio::sync::mpsc;

/// One life: it lasts over lost connections, as an actor's does.
#[derive(Debug)]
pub(super) struct Identity {
    /// The index that the learner gave it.
    pub(super) actor: Option<u64>,
    pub(super) incarnation: u64,
    next_sequence: u64,
    /// Unrolls that were not acknowledged.
    waiting: VecDeque<UnrollHeader>,
}

impl Identity {
    /// A new life with an old index, if there is one.
    pub(super) fn new(actor: Option<u64>) -> Self {
        Self { actor, incarnation: rand::random(), next_sequence: 0, waiting: VecDeque::new() }
    }

    /// What was under way when the last connection was lost is sent again, as it was.
    pub(super) fn send_again(
        &self,
        up: &mpsc::Sender<UnrollMessage>,
        reply: &JoinReply,
        payload: &Bytes,
    ) -> Result<()> {
        let of = |header: &UnrollHeader| UnrollHeader { actor: reply.actor, ..header.clone() };
        self.waiting.iter().try_for_each(|header| send(up, of(header), payload))
    }

    /// Sends unrolls made with `version` until so many are under way.
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
                behaviour: Behaviour::Policy.into(),
                ..UnrollHeader::default()
            };
            self.next_sequence += 1;
            self.waiting.push_back(header.clone());
            send(up, header, payload)?;
        }
        Ok(())
    }

    /// Answers for this one no more.
    pub(super) fn settle(&mut self, ack: &UnrollAck) {
        self.waiting.retain(|header| header.sequence != ack.sequence);
    }
}

/// As many as are acknowledged: there is room, or the connection is lost.
fn send(up: &mpsc::Sender<UnrollMessage>, header: UnrollHeader, payload: &Bytes) -> Result<()> {
    let message = UnrollMessage { header: Some(header), payload: payload.clone() };
    up.try_send(message).context("the stream of unrolls is lost")
}
