//! Making a connection: TCP, HTTP/2, `Join`.

use std::time::Duration;

use comic_proto::PROTOCOL_VERSION;
use comic_proto::v1::learner_client::LearnerClient;
use comic_proto::v1::{JoinReply, JoinRequest};
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request, Status};

use super::Terms;
use crate::Error;

/// Deadline of a unary call.
const CALL: Duration = Duration::from_secs(10);
/// Pieces of parameters and assets are far smaller; the experiment with the names of some thousand clips fits.
const MESSAGE_LIMIT: usize = 16 << 20;

/// Why there is no connection.
#[derive(Debug)]
pub(super) enum Failure {
    /// Try again.
    Lost(String),
    /// Trying again cannot help.
    Fatal(Error),
}

impl From<Status> for Failure {
    fn from(status: Status) -> Self {
        Self::Lost(describe(&status))
    }
}

/// A status without its metadata.
pub(super) fn describe(status: &Status) -> String {
    format!("{}: {}", status.code(), status.message())
}

/// A connection that has joined.
#[derive(Debug)]
pub(super) struct Link {
    pub(super) client: LearnerClient<Channel>,
    pub(super) reply: JoinReply,
}

/// Connects, always as the same process.
#[derive(Debug)]
pub(super) struct Connector {
    address: String,
    endpoint: Endpoint,
    incarnation: u64,
    actor: Option<u64>,
    learner_epoch: Option<u64>,
}

impl Connector {
    pub(super) fn new(address: &str) -> Result<Self, Error> {
        let url = || Error::Url { url: address.to_string() };
        let endpoint = Endpoint::from_shared(address.to_string()).map_err(|_| url())?;
        if endpoint.uri().scheme_str() != Some("http") || endpoint.uri().host().is_none() {
            return Err(url());
        }
        // Keep-alive while idle: a peer that vanished without a word is otherwise never noticed. The connection's
        // window exceeds the parameter stream's, so an unread version cannot stall the acknowledgements.
        let endpoint = endpoint
            .connect_timeout(Duration::from_secs(5))
            .tcp_nodelay(true)
            .http2_keep_alive_interval(Duration::from_secs(15))
            .keep_alive_timeout(Duration::from_secs(10))
            .keep_alive_while_idle(true)
            .initial_stream_window_size(1 << 20)
            .initial_connection_window_size(4 << 20);
        Ok(Self {
            address: address.to_string(),
            endpoint,
            incarnation: rand::random(),
            actor: None,
            learner_epoch: None,
        })
    }

    pub(super) fn address(&self) -> &str {
        &self.address
    }

    pub(super) fn incarnation(&self) -> u64 {
        self.incarnation
    }

    pub(super) async fn connect(&mut self) -> Result<Link, Failure> {
        let channel = self.endpoint.connect().await.map_err(|error| Failure::Lost(with_sources(&error)))?;
        let mut client = LearnerClient::new(channel).max_decoding_message_size(MESSAGE_LIMIT);
        let mut request =
            Request::new(JoinRequest { incarnation: self.incarnation, actor: self.actor, protocol: PROTOCOL_VERSION });
        request.set_timeout(CALL);
        let reply = match client.join(request).await {
            Ok(reply) => reply.into_inner(),
            Err(status) => return Err(self.judge(&status)),
        };
        if self.learner_epoch.replace(reply.learner_epoch) != Some(reply.learner_epoch) {
            tracing::info!(actor = reply.actor, learner_epoch = reply.learner_epoch, "joined the learner");
        } else {
            tracing::info!(actor = reply.actor, "reconnected to the learner");
        }
        self.actor = Some(reply.actor);
        Ok(Link { client, reply })
    }

    /// Connects and checks that the experiment is still `terms`.
    pub(super) async fn reconnect(&mut self, terms: &Terms) -> Result<Link, Failure> {
        let link = self.connect().await?;
        if Terms::of(&link.reply) == *terms { Ok(link) } else { Err(Failure::Fatal(Error::Changed)) }
    }

    fn judge(&self, status: &Status) -> Failure {
        match status.code() {
            Code::InvalidArgument | Code::FailedPrecondition | Code::Unimplemented | Code::PermissionDenied => {
                let message = describe(status);
                // Who was let in once is configured rightly; a new process may be let in again.
                Failure::Fatal(match self.actor {
                    Some(actor) => Error::Dismissed { actor, message },
                    None => Error::Refused { url: self.address.clone(), message },
                })
            }
            _ => Failure::Lost(describe(status)),
        }
    }
}

/// The transport's own message is `transport error`; what happened is in its sources.
fn with_sources(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        text = format!("{text}: {error}");
        source = error.source();
    }
    text
}
