//! Unrolls, acknowledgements and parameters over one connection.

use std::sync::Arc;

use comic_proto::Client;
use comic_proto::v1::{UnrollAck, UnrollMessage, Verdict, WatchRequest};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio_stream::wrappers::ReceiverStream;

use super::connection::{Link, describe};
use super::{Assembled, Assembler, ExchangeLimits, Outbox};
use crate::mailbox::Mailbox;
use crate::worker::FinishedUnroll;

/// Acknowledgements that may wait for the exchange to read them.
const ACKS: usize = 64;

/// Why an exchange is over.
#[derive(Debug)]
pub(super) enum Ended {
    /// The workers have ended and every unroll is acknowledged.
    Drained,
    /// The learner says the run is over.
    Over,
    /// The connection is lost.
    Lost(String),
}

pub(super) struct Exchange<'a> {
    pub(super) unrolls: &'a mut mpsc::Receiver<FinishedUnroll>,
    pub(super) outbox: &'a mut Outbox,
    pub(super) mailbox: &'a Arc<Mailbox>,
    pub(super) limits: ExchangeLimits,
}

impl Exchange<'_> {
    /// Runs until the connection ends. Dropping the task set at the end closes both streams.
    pub(super) async fn run(self, link: Link, incarnation: u64) -> Ended {
        let Link { client, reply } = link;
        let actor = reply.actor;
        let (up, outbound) = mpsc::channel(1);
        let (acked, mut acks) = mpsc::channel(ACKS);
        let mut streams = JoinSet::new();
        streams.spawn(send(client.clone(), outbound, acked));
        let request = WatchRequest { actor, incarnation };
        streams.spawn(watch(client, request, Assembler::new(self.limits.parameters), Arc::clone(self.mailbox)));

        self.mailbox.reconnected();
        self.outbox.rewind();
        let mut producing = true;
        let ended = loop {
            if !producing && self.outbox.is_empty() {
                break Ended::Drained;
            }
            tokio::select! {
                Some(ack) = acks.recv() => {
                    // Before the ticket is returned, so that the worker continues with this version or a newer one.
                    self.mailbox.announce(ack.learner_epoch, ack.version);
                    self.outbox.settle(&ack);
                    if ack.verdict() == Verdict::Rejoin && ack.learner_epoch != reply.learner_epoch {
                        break Ended::Lost("the learner has restarted: joining again".into());
                    }
                }
                Ok(permit) = up.reserve(), if self.outbox.has_unsent() => {
                    if let Some(message) = self.outbox.send(actor, incarnation) {
                        permit.send(message);
                    }
                }
                unroll = self.unrolls.recv(), if producing && self.outbox.has_room() => match unroll {
                    Some(unroll) => self.outbox.push(unroll, incarnation),
                    None => producing = false,
                },
                Some(ended) = streams.join_next() => {
                    break ended.unwrap_or_else(|error| Ended::Lost(error.to_string()));
                }
            }
        };
        // Unrolls acknowledged before the end are not sent again.
        while let Ok(ack) = acks.try_recv() {
            self.mailbox.announce(ack.learner_epoch, ack.version);
            self.outbox.settle(&ack);
        }
        ended
    }
}

async fn send(mut client: Client, outbound: mpsc::Receiver<UnrollMessage>, acked: mpsc::Sender<UnrollAck>) -> Ended {
    let mut stream = match client.send_unrolls(ReceiverStream::new(outbound)).await {
        Ok(reply) => reply.into_inner(),
        Err(status) => return Ended::Lost(describe(&status)),
    };
    loop {
        match stream.message().await {
            Ok(Some(ack)) => {
                if acked.send(ack).await.is_err() {
                    return Ended::Lost("the exchange is over".into());
                }
            }
            Ok(None) => return Ended::Lost("the learner ended the stream of acknowledgements".into()),
            Err(status) => return Ended::Lost(describe(&status)),
        }
    }
}

async fn watch(mut client: Client, request: WatchRequest, mut assembler: Assembler, mailbox: Arc<Mailbox>) -> Ended {
    let mut stream = match client.watch_parameters(request).await {
        Ok(reply) => reply.into_inner(),
        Err(status) => return Ended::Lost(describe(&status)),
    };
    loop {
        let chunk = match stream.message().await {
            Ok(Some(chunk)) => chunk,
            Ok(None) => return Ended::Lost("the learner ended the stream of parameters".into()),
            Err(status) => return Ended::Lost(describe(&status)),
        };
        match assembler.push(&chunk) {
            Ok(None) => {}
            Ok(Some(Assembled::RunOver)) => return Ended::Over,
            Ok(Some(Assembled::Act(directive))) => {
                tracing::debug!(version = directive.version, "new parameters");
                mailbox.publish(directive);
            }
            Err(error) => return Ended::Lost(error.to_string()),
        }
    }
}
