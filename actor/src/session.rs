//! The connection to the learner, for the whole time of the process.
//!
//! [`join`] asks the learner for this actor's index and for the experiment. [`Joined::run`] then sends unrolls and receives
//! parameters. It reconnects after every loss, with back-off, and sends unrolls without acknowledgement again, in order. It
//! ends only when the experiment changes, when the learner refuses the actor, when the learner has not answered for
//! [`JoinSettings::give_up_after`], or when the run is over.
//!
//! A refused token or certificate ends an actor that has never joined, after some minutes. An actor that has joined before
//! retries: the files are read for every connection and may be renewed.

mod assets;
mod backoff;
mod connection;
mod exchange;
mod follower;
mod outbox;
mod parameters;

use std::collections::HashMap;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use comic_experiment::{Experiment, TaskSpec};
use comic_proto::v1::{Environments, JoinReply};
use comic_proto::{Access, UnrollLayout, UnrollShape};
use tokio::sync::{mpsc, watch};
use tokio::time::Instant;

use crate::Error;
use crate::mailbox::Mailbox;
use crate::worker::FinishedUnroll;
use backoff::Backoff;
use connection::{Connector, Link};
use exchange::{Ended, Exchange};
use outbox::Outbox;

pub use assets::default_cache;
pub(crate) use connection::Failure;
pub use follower::{Fetched, Follower};
pub use outbox::Settled;
pub use parameters::{Assembled, Assembler};

/// A shorter connection counts as a failure: the back-off continues to grow.
const STABLE: Duration = Duration::from_secs(5);

/// The learner's address, the asset cache, and the size of this actor.
#[derive(Clone, Debug)]
pub struct JoinSettings {
    /// For instance `http://host:7070`.
    pub learner: String,
    /// Certificates and token.
    pub access: Access,
    /// Directory of the asset cache; [`default_cache`] when absent.
    pub cache: Option<PathBuf>,
    /// A name that stays the same over restarts. A newer process of the same name replaces the older one.
    pub name: Option<String>,
    /// Threads; the experiment's number when absent.
    pub threads: Option<usize>,
    /// Environments a thread; the experiment's number when absent.
    pub environments: Option<usize>,
    /// How long to go on while the learner does not answer; for ever when absent.
    pub give_up_after: Option<Duration>,
}

/// ExchangeLimits of an exchange.
#[derive(Clone, Copy, Debug)]
pub struct ExchangeLimits {
    /// Most unrolls without acknowledgement; when there are so many, no unroll is taken from the workers.
    pub window: usize,
    /// Most bytes of parameters in one version.
    pub parameters: u64,
    /// How long a stopped actor continues to send finished unrolls.
    pub flush: Duration,
}

/// The learner's reply to `Join`, and the connection.
#[derive(Debug)]
pub struct Joined {
    /// The experiment, resolved.
    pub experiment: Experiment,
    /// Sizes and names of the task.
    pub spec: TaskSpec,
    /// Layout of the unrolls; its hash is the learner's.
    pub layout: Arc<UnrollLayout>,
    /// This actor's index.
    pub actor: u64,
    /// Seed of this actor's random numbers.
    pub seed: u64,
    /// The numbers of this actor's environments in lockstep, never empty; none without lockstep.
    pub environments: Option<Range<u32>>,
    /// The experiment's clip sources and, in transfer, its low level, with their files on this machine.
    pub assets: HashMap<String, PathBuf>,
    terms: Terms,
    give_up_after: Option<Duration>,
    connector: Connector,
    link: Link,
}

/// What must be the same in every reply to `Join`.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Terms {
    experiment: String,
    task_spec: String,
    layout_hash: Vec<u8>,
    environments: Option<Environments>,
}

impl Terms {
    fn of(reply: &JoinReply) -> Self {
        Self {
            experiment: lasting(&reply.experiment),
            task_spec: reply.task_spec.clone(),
            layout_hash: reply.layout_hash.clone(),
            environments: reply.environments,
        }
    }
}

/// The part of an experiment that must not change while an actor runs. Budget, learner settings and actor settings may
/// change.
fn lasting(document: &str) -> String {
    let Ok(mut experiment) = Experiment::from_toml("the learner's experiment", document) else {
        return document.to_string();
    };
    let default = Experiment::default();
    experiment.budget = default.budget;
    experiment.learner = default.learner;
    experiment.actor = default.actor;
    experiment.to_toml().unwrap_or_else(|_| document.to_string())
}

/// Joins the learner, and fetches the assets that this machine lacks.
///
/// # Errors
/// [`Error::GaveUp`], a refusal, an experiment that cannot be used, no cache directory, a full disk; [`Error::Stopped`] when
/// `stop` became true first.
pub async fn join(options: &JoinSettings, mut stop: watch::Receiver<bool>) -> Result<Joined, Error> {
    tokio::select! {
        joined = join_patiently(options) => joined,
        _ = stop.wait_for(|stop| *stop) => Err(Error::Stopped),
    }
}

async fn join_patiently(options: &JoinSettings) -> Result<Joined, Error> {
    let mut connector = Connector::new(options)?;
    let mut backoff = Backoff::new(options.give_up_after);
    loop {
        match attempt(options, &mut connector).await {
            Ok((link, CheckedReply { experiment, spec, layout, environments }, assets)) => {
                let reply = &link.reply;
                return Ok(Joined {
                    experiment,
                    spec,
                    layout,
                    actor: reply.actor,
                    seed: reply.seed,
                    environments,
                    assets,
                    terms: Terms::of(reply),
                    give_up_after: options.give_up_after,
                    connector,
                    link,
                });
            }
            Err(failure) => backoff.retry(&options.learner, failure).await?,
        }
    }
}

type Reply = (Link, CheckedReply, HashMap<String, PathBuf>);

async fn attempt(options: &JoinSettings, connector: &mut Connector) -> Result<Reply, Failure> {
    let mut link = connector.connect(0).await?;
    let checked = read_reply(&link.reply).map_err(Failure::Fatal)?;
    let assets = assets::fetch(&mut link.client, &link.reply.assets, options.cache.as_deref()).await;
    let assets = assets.map_err(Failure::after_an_answer)?;
    Ok((link, checked, assets))
}

/// The checked content of a reply.
struct CheckedReply {
    experiment: Experiment,
    spec: TaskSpec,
    layout: Arc<UnrollLayout>,
    environments: Option<Range<u32>>,
}

fn read_reply(reply: &JoinReply) -> Result<CheckedReply, Error> {
    let experiment = Experiment::from_toml("the learner's experiment", &reply.experiment)?;
    let spec: TaskSpec = toml::from_str(&reply.task_spec)?;
    let layout = UnrollLayout::new(UnrollShape::new(&spec, &experiment));
    if reply.layout_hash != layout.hash()[..] {
        return Err(Error::Disagreement { what: "the layout of an unroll" });
    }
    let environments = read_environments(reply, &experiment)?;
    Ok(CheckedReply { experiment, spec, layout: Arc::new(layout), environments })
}

fn read_environments(reply: &JoinReply, experiment: &Experiment) -> Result<Option<Range<u32>>, Error> {
    let (lockstep, batch) = (experiment.unroll.lockstep, experiment.unroll.batch);
    let disagreement = Error::Disagreement { what: "the environments of a run in lockstep" };
    match reply.environments {
        None if !lockstep => Ok(None),
        Some(Environments { first, count }) if lockstep => {
            let end = first.checked_add(count).filter(|end| count > 0 && *end as usize <= batch);
            Ok(Some(first..end.ok_or(disagreement)?))
        }
        _ => Err(disagreement),
    }
}

impl Joined {
    /// The file of the frozen low level, if the experiment is a transfer.
    ///
    /// # Errors
    /// A file that cannot be read, or one that the learner did not announce.
    pub fn low_level(&self) -> Result<Option<Vec<u8>>, Error> {
        assets::low_level(&self.experiment, &self.assets)
    }

    /// Sends unrolls and receives parameters until the run is over, or until all workers have ended and every unroll is
    /// acknowledged; both are `Ok`. When `stop` becomes true it sends the finished unrolls, for at most `limits.flush`.
    ///
    /// # Errors
    /// [`Error::Changed`], [`Error::GaveUp`], a refusal at a reconnect.
    pub async fn run(
        self,
        limits: ExchangeLimits,
        unrolls: mpsc::Receiver<FinishedUnroll>,
        mailbox: Arc<Mailbox>,
        stop: watch::Receiver<bool>,
    ) -> Result<Settled, Error> {
        let mut outbox = Outbox::new(limits.window, self.layout.hash());
        let ended = tokio::select! {
            ended = self.keep_connected(limits, unrolls, mailbox, &mut outbox) => ended,
            () = deadline(stop, limits.flush) => Ok(false),
        };
        if !outbox.is_empty() {
            tracing::warn!(unrolls = outbox.len(), "some unrolls were not acknowledged in time");
        }
        ended.map(|over| Settled { over, ..outbox.settled() })
    }

    /// Returns whether it ended because the run is over.
    async fn keep_connected(
        mut self,
        limits: ExchangeLimits,
        mut unrolls: mpsc::Receiver<FinishedUnroll>,
        mailbox: Arc<Mailbox>,
        outbox: &mut Outbox,
    ) -> Result<bool, Error> {
        let mut backoff = Backoff::new(self.give_up_after);
        let mut link = Some(self.link);
        loop {
            if unrolls.is_closed() && unrolls.is_empty() && outbox.is_empty() {
                return Ok(false);
            }
            let attempt = match link.take() {
                Some(link) => Ok(link),
                None => self.connector.reconnect(&self.terms, outbox.acknowledged()).await,
            };
            let failure = match attempt {
                Ok(link) => {
                    backoff.answered();
                    let since = Instant::now();
                    let exchange = Exchange { unrolls: &mut unrolls, outbox, mailbox: &mailbox, limits };
                    match exchange.run(link, self.connector.incarnation()).await {
                        Ended::Drained => return Ok(false),
                        Ended::Over => return Ok(true),
                        Ended::Lost(reason) => {
                            if since.elapsed() > STABLE {
                                backoff.reset();
                            }
                            Failure::Lost(reason)
                        }
                    }
                }
                Err(failure) => failure,
            };
            backoff.retry(self.connector.address(), failure).await?;
        }
    }
}

async fn deadline(mut stop: watch::Receiver<bool>, flush: Duration) {
    if stop.wait_for(|stop| *stop).await.is_err() {
        // The sender is gone, so no stop can come.
        std::future::pending::<()>().await;
    }
    tokio::time::sleep(flush).await;
}

#[cfg(test)]
mod tests;
