//! Connects to the learner: TCP, HTTP/2, `Join`.

use std::time::Duration;

use comic_proto::v1::learner_client::LearnerClient;
use comic_proto::v1::{JoinReply, JoinRequest};
use comic_proto::{Access, AccessError, Client, PROTOCOL_VERSION, chain, distrusted, no_connection, url_of_sibling};
use tonic::{Code, Request, Status};

use super::{JoinSettings, Terms};
use crate::Error;

/// Deadline of a unary call.
pub(super) const CALL: Duration = Duration::from_secs(10);
/// How often one learner may send an actor to another, until one takes it.
const MOST_HOPS: usize = 2;
/// Bytes of the host and port of another learner: a host's name has at most 253.
const LEARNER_LIMIT: usize = 260;
/// Room for the experiment with the names of some thousand clips. Pieces of parameters and assets are far smaller.
const MESSAGE_LIMIT: usize = 16 << 20;

/// Why there is no connection.
#[derive(Debug)]
pub(crate) enum Failure {
    /// The learner did not answer. Retry.
    Lost(String),
    /// It answered, and may accept this process later. Retry.
    Postponed(String),
    /// It does not accept this process's token or certificate, or this process does not accept the learner's. Retry for some
    /// minutes: after a renewal one side has the new secret before the other.
    Unwelcome(Error),
    /// A retry cannot help.
    Fatal(Error),
}

impl From<Status> for Failure {
    fn from(status: Status) -> Self {
        match status.code() {
            // All places are taken, or too many calls are in flight.
            Code::ResourceExhausted => Self::Postponed(describe(&status)),
            _ => Self::Lost(describe(&status)),
        }
    }
}

impl Failure {
    /// For a peer that was accepted before. Its configuration is correct, and it may be accepted again, for instance with a
    /// renewed token.
    pub(super) fn transient(self) -> Self {
        match self {
            Self::Unwelcome(error) | Self::Fatal(error) => Self::Postponed(chain(&error)),
            retry => retry,
        }
    }

    /// For a call after one that the learner has answered.
    pub(super) fn after_an_answer(self) -> Self {
        match self {
            Self::Lost(reason) => Self::Postponed(reason),
            other => other,
        }
    }
}

/// Checks address, certificates and token.
pub(super) fn check(address: &str, access: &Access) -> Result<(), AccessError> {
    access.lasting_endpoint(address)?;
    access.bearer().map(drop)
}

/// Connects by TCP and HTTP/2.
pub(super) async fn connect(address: &str, access: &Access) -> Result<Client, Failure> {
    // The files matched at the start. During a renewal they may not match for a moment.
    let renewed = |error: AccessError| Failure::Lost(chain(&error));
    let endpoint = access.lasting_endpoint(address).map_err(renewed)?;
    let bearer = access.bearer().map_err(renewed)?;
    let channel = endpoint.connect().await.map_err(|error| match distrusted(&error) {
        true => unwelcome(address, chain(&error)),
        false => Failure::Lost(no_connection(&error)),
    })?;
    Ok(LearnerClient::with_interceptor(channel, bearer).max_decoding_message_size(MESSAGE_LIMIT))
}

pub(super) fn unwelcome(address: &str, message: String) -> Failure {
    Failure::Unwelcome(Error::Unwelcome { url: address.to_owned(), message })
}

/// A status with its causes and without its metadata.
pub(super) fn describe(status: &Status) -> String {
    format!("{}: {}", status.code(), chain(status))
}

/// A connection that has joined.
#[derive(Debug)]
pub(super) struct Link {
    pub(super) client: Client,
    pub(super) reply: JoinReply,
}

/// Connects, always as the same process.
#[derive(Debug)]
pub(super) struct Connector {
    address: String,
    /// The learner that takes this actor, if the one at `address` sent it there.
    home: Option<String>,
    access: Access,
    name: String,
    threads: Option<u32>,
    environments: Option<u32>,
    incarnation: u64,
    actor: Option<u64>,
    learner_epoch: Option<u64>,
    /// The run that this actor belongs to.
    run: Option<u64>,
}

impl Connector {
    /// Checks address, certificates and token, so that their errors are reported at once.
    pub(super) fn new(options: &JoinSettings) -> Result<Self, Error> {
        let number = |given: Option<usize>| given.map(|number| u32::try_from(number).unwrap_or(u32::MAX));
        let connector = Self {
            address: options.learner.clone(),
            home: None,
            access: options.access.clone(),
            name: options.name.clone().unwrap_or_default(),
            threads: number(options.threads),
            environments: number(options.environments),
            incarnation: rand::random(),
            actor: None,
            learner_epoch: None,
            run: None,
        };
        check(&connector.address, &connector.access)?;
        Ok(connector)
    }

    pub(super) fn address(&self) -> &str {
        &self.address
    }

    pub(super) fn incarnation(&self) -> u64 {
        self.incarnation
    }

    /// Connects and joins, at the learner that takes this actor. If that one is lost, the next attempt begins at the first one again.
    /// `acknowledged` is the sequence number below which every unroll is acknowledged.
    pub(super) async fn connect(&mut self, acknowledged: u64) -> Result<Link, Failure> {
        for _ in 0..=MOST_HOPS {
            let address = self.home.take().unwrap_or_else(|| self.address.clone());
            let link = self.join(&address, acknowledged).await.map_err(|failure| self.at(&address, failure))?;
            if link.reply.learner.is_empty() {
                self.home = Some(address);
                return Ok(self.joined(link));
            }
            if link.reply.learner.len() > LEARNER_LIMIT {
                let wrong =
                    format!("the learner at {address} names another one that no host can have: see --advertise");
                return Err(Failure::Lost(wrong));
            }
            self.home = Some(url_of_sibling(&self.address, &link.reply.learner));
        }
        self.home = None;
        Err(Failure::Postponed("the learners send this actor from one to the other".into()))
    }

    /// Names the learner that failed, if it is not the first one.
    fn at(&self, address: &str, failure: Failure) -> Failure {
        match failure {
            Failure::Lost(reason) if address != self.address => Failure::Lost(format!("{address}: {reason}")),
            Failure::Postponed(reason) if address != self.address => Failure::Postponed(format!("{address}: {reason}")),
            other => other,
        }
    }

    async fn join(&self, address: &str, acknowledged: u64) -> Result<Link, Failure> {
        let mut client = self.client(address).await?;
        let mut request = Request::new(JoinRequest {
            incarnation: self.incarnation,
            actor: self.actor,
            protocol: PROTOCOL_VERSION,
            threads: self.threads,
            environments: self.environments,
            acknowledged,
            name: self.name.clone(),
            run: self.run,
        });
        request.set_timeout(CALL);
        let reply = match client.join(request).await {
            Ok(reply) => reply.into_inner(),
            Err(status) => return Err(self.judge(address, status)),
        };
        Ok(Link { client, reply })
    }

    /// Keeps what the learner said, for the next time.
    fn joined(&mut self, link: Link) -> Link {
        let reply = &link.reply;
        if self.learner_epoch.replace(reply.learner_epoch) != Some(reply.learner_epoch) {
            tracing::info!(actor = reply.actor, learner_epoch = reply.learner_epoch, "joined the learner");
        } else {
            tracing::info!(actor = reply.actor, "reconnected to the learner");
        }
        self.actor = Some(reply.actor);
        // 0 means that the run has no number.
        self.run = Some(reply.run).filter(|run| *run != 0);
        link
    }

    async fn client(&self, address: &str) -> Result<Client, Failure> {
        let connected = connect(address, &self.access).await;
        connected.map_err(|failure| if self.actor.is_some() { failure.transient() } else { failure })
    }

    /// Whether a certificate is refused, and this actor has never joined.
    fn is_barred(&self, error: &(dyn std::error::Error + 'static)) -> bool {
        self.actor.is_none() && distrusted(error)
    }

    /// Connects and checks that the experiment is still `terms`.
    pub(super) async fn reconnect(&mut self, terms: &Terms, acknowledged: u64) -> Result<Link, Failure> {
        let link = self.connect(acknowledged).await?;
        if Terms::of(&link.reply) == *terms { Ok(link) } else { Err(Failure::Fatal(Error::Changed)) }
    }

    fn judge(&self, address: &str, status: Status) -> Failure {
        let message = describe(&status);
        // An actor that has joined before has a correct configuration. It may be accepted again, for instance with a
        // renewed token.
        match (status.code(), self.actor) {
            (Code::Unauthenticated, None) => unwelcome(address, status.message().to_string()),
            (Code::Unauthenticated, Some(_)) => Failure::Postponed(message),
            (
                Code::InvalidArgument | Code::FailedPrecondition | Code::Unimplemented | Code::PermissionDenied,
                actor,
            ) => Failure::Fatal(match actor {
                Some(actor) => Error::Dismissed { actor, message },
                None => Error::Refused { url: address.to_owned(), message },
            }),
            (Code::Aborted, _) => Failure::Fatal(Error::Superseded { message }),
            _ if self.is_barred(&status) => unwelcome(address, chain(&status)),
            _ => status.into(),
        }
    }
}
