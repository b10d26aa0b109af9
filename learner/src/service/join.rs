//! `Join`: which actors are accepted, and what they are told.

use std::sync::Arc;
use std::time::{Duration, Instant};

use comic_experiment::{Experiment, TaskSpec};
use comic_proto::v1::{self, Environments, JoinReply, JoinRequest};
use comic_proto::{MAX_SEQUENCE, PROTOCOL_VERSION};
use comic_replay::Batcher;
use tonic::Status;

use super::assignments::{Assignment, Assignments, Denied};
use super::peer::{Owner, Peer};
use super::placement::Placement;
use super::roster::{Joined, Name, Roster, superseded};
use super::shutdown::Shutdown;
use crate::error::{Error, Result};
use crate::observe::prometheus::Prometheus;
use crate::quota::Quota;

/// Joins under one name at once, and then one in each interval. An actor that loses its connection again and again waits longer.
const JOINS_AT_ONCE: u32 = 30;
/// See [`JOINS_AT_ONCE`].
const JOIN_INTERVAL: Duration = Duration::from_secs(2);
/// Bytes of an actor's name, as many as a host's name can have.
const NAME_LIMIT: usize = 253;

/// What every actor is told.
#[derive(Debug)]
pub(super) struct JoinTerms {
    /// The run's number.
    run: u64,
    /// The resolved experiment, TOML.
    experiment: String,
    /// The task's sizes and names, TOML.
    task_spec: String,
    /// The experiment's seed.
    seed: u64,
    /// Files that actors may not have.
    assets: Vec<v1::Asset>,
    /// Threads, and environments of each, of an actor whose command line names none.
    actor: (u64, u64),
}

impl JoinTerms {
    /// The terms of an experiment.
    ///
    /// # Errors
    /// When the experiment or the specification cannot be written as TOML.
    pub(super) fn new(run: u64, experiment: &Experiment, spec: &TaskSpec, assets: Vec<v1::Asset>) -> Result<Self> {
        Ok(Self {
            run,
            experiment: experiment.to_toml()?,
            task_spec: toml::to_string(spec)
                .map_err(|error| Error::Defect(format!("the task's specification is no TOML: {error}")))?,
            seed: experiment.seed,
            assets,
            actor: (experiment.actor.threads as u64, experiment.actor.environments as u64),
        })
    }
}

/// Accepts actors.
#[derive(Debug)]
pub(super) struct Join {
    pub(super) terms: JoinTerms,
    pub(super) batcher: Batcher,
    pub(super) roster: Arc<Roster>,
    /// Only in lockstep.
    pub(super) assignments: Option<Arc<Assignments>>,
    pub(super) shutdown: Shutdown,
    pub(super) prometheus: Arc<Prometheus>,
    /// The learner epoch.
    pub(super) epoch: u64,
    /// Limits the joins under each name of each owner.
    pub(super) joins: Joins,
    /// Only if several learners train this run.
    pub(super) placement: Option<Arc<Placement>>,
}

/// The limit on the joins under each name. The owner is part of it, so that nobody uses up the joins of a name of others.
pub(super) type Joins = Quota<(Option<Owner>, String)>;

pub(super) fn joins() -> Joins {
    Quota::new(JOINS_AT_ONCE, JOIN_INTERVAL)
}

/// A refusal: the value of the label `result` under which `comic_joins` counts it, and the status.
struct Refusal(&'static str, Status);

impl Join {
    /// Answers a request on the connection of this peer, and counts the answer.
    pub(super) fn answer(&self, request: &JoinRequest, peer: Option<&Peer>) -> Result<JoinReply, Status> {
        let owner = peer.and_then(|peer| peer.owner);
        let checked = self.check(request, owner);
        if let (Ok(()), Some(learner)) = (&checked, self.elsewhere(request, owner)) {
            self.prometheus.joins.of("elsewhere").inc();
            return Ok(JoinReply { learner, ..JoinReply::default() });
        }
        let answer = checked.and_then(|()| self.accept(request, owner));
        let result = answer.as_ref().map_or_else(|Refusal(result, _)| *result, |_| "joined");
        self.prometheus.joins.of(result).inc();
        if let Ok(JoinReply { actor, .. }) = &answer {
            let incarnation = format_args!("{:016x}", request.incarnation);
            let address = peer.map(|peer| peer.address);
            tracing::info!(actor, incarnation, peer = ?address, "actor joined");
        }
        answer.map_err(|Refusal(_, status)| status)
    }

    /// Where the actor has to go, if it belongs to another rank.
    fn elsewhere(&self, request: &JoinRequest, owner: Option<Owner>) -> Option<String> {
        // At the end of a run every rank says so, and another one may have ended.
        let placement = self.placement.as_ref().filter(|_| !self.shutdown.run_is_over())?;
        let JoinRequest { name, incarnation, actor, .. } = request;
        let name = if name.is_empty() { format!("{incarnation:016x}") } else { name.clone() };
        placement.elsewhere((owner, name), *actor, Instant::now()).map(str::to_owned)
    }

    /// Checks what does not depend on other actors.
    fn check(&self, request: &JoinRequest, owner: Option<Owner>) -> Result<(), Refusal> {
        let JoinRequest { protocol, acknowledged, name, run, .. } = request;
        if *protocol != PROTOCOL_VERSION {
            let status = format!(
                "this learner speaks protocol {PROTOCOL_VERSION}, the actor {protocol}: run both from the same release"
            );
            return Err(Refusal("refused", Status::failed_precondition(status)));
        }
        if *acknowledged > MAX_SEQUENCE || name.len() > NAME_LIMIT {
            let status = format!(
                "`acknowledged` is {acknowledged}, at most {MAX_SEQUENCE} is possible; the name has {} bytes, at most \
                 {NAME_LIMIT} are allowed",
                name.len()
            );
            return Err(Refusal("refused", Status::invalid_argument(status)));
        }
        if !name.is_empty() && !self.joins.take((owner, name.clone())) {
            let per_minute = 60 / JOIN_INTERVAL.as_secs();
            let status = format!(
                "more than {per_minute} joins a minute under the name `{name}`: is another actor running under it, or does \
                 this one crash?"
            );
            return Err(Refusal("limited", Status::resource_exhausted(status)));
        }
        // The epochs and versions of another run belong to other policies.
        if run.is_some_and(|run| run != self.terms.run) {
            let status = "another run has begun here since: start the actor again";
            return Err(Refusal("refused", Status::failed_precondition(status)));
        }
        // When the run is over an actor may join, because the parameters then tell it so.
        if self.shutdown.has_begun()
            && let Some(status) = self.shutdown.status()
        {
            return Err(Refusal("draining", status));
        }
        Ok(())
    }

    fn accept(&self, request: &JoinRequest, owner: Option<Owner>) -> Result<JoinReply, Refusal> {
        let JoinRequest { incarnation, actor, acknowledged, ref name, .. } = *request;
        match self.roster.join(incarnation, Name { text: name, owner }, actor, Instant::now()) {
            Joined::Welcome => {}
            Joined::Full => {
                let status = "there are as many actors as --max-actors allows: try again later";
                return Err(Refusal("full", Status::resource_exhausted(status)));
            }
            Joined::Superseded => return Err(Refusal("refused", superseded())),
            Joined::Foreign => {
                let status =
                    format!("the name `{name}` belongs to an actor with another certificate: choose another --name");
                return Err(Refusal("refused", Status::permission_denied(status)));
            }
        }
        let stand_by = |_: &Refusal| self.roster.stand_by(incarnation);
        let environments = self.environments(request).inspect_err(stand_by)?;
        let joined = self.batcher.join(incarnation, actor);
        let joined = joined
            .map_err(|refused| Refusal("refused", Status::failed_precondition(refused.to_string())))
            .inspect_err(stand_by)?;
        self.roster.set_index(incarnation, joined.actor);
        let next_sequence = self.batcher.catch_up(joined.actor, acknowledged).ok_or_else(|| {
            let status = format!(
                "the learner cannot have lost all unrolls before number {acknowledged}, which this actor had acknowledged: \
                 start the actor again"
            );
            Refusal("refused", Status::failed_precondition(status))
        });
        let next_sequence = next_sequence.inspect_err(stand_by)?;
        // In lockstep the seed belongs to the environments and not to the actor that simulates them.
        let index = if environments.is_some() { self.epoch } else { joined.actor };
        Ok(JoinReply {
            learner_epoch: self.epoch,
            actor: joined.actor,
            seed: comic_experiment::seed::derive(self.terms.seed, index),
            experiment: self.terms.experiment.clone(),
            task_spec: self.terms.task_spec.clone(),
            assets: self.terms.assets.clone(),
            layout_hash: self.batcher.layout().hash().to_vec(),
            next_sequence,
            environments,
            run: self.terms.run,
            learner: String::new(),
        })
    }

    /// The environments that an actor simulates in lockstep; `None` in other runs.
    fn environments(&self, request: &JoinRequest) -> Result<Option<Environments>, Refusal> {
        let JoinRequest { incarnation, actor, threads, environments, .. } = *request;
        let Some(assignments) = &self.assignments else { return Ok(None) };
        let wanted = threads.map_or(self.terms.actor.0, u64::from) * environments.map_or(self.terms.actor.1, u64::from);
        let now = Instant::now();
        let claimed = assignments.claim(incarnation, wanted, actor.is_some(), |owner| self.roster.expects(owner, now));
        let Assignment { environments, inherited, left } = claimed.map_err(|denied| match denied {
            Denied::Taken => {
                let status = "other actors simulate every environment of this run in lockstep: waiting for a free one";
                Refusal("full", Status::resource_exhausted(status))
            }
            Denied::Lost => {
                let status = "in lockstep this actor's environments began anew without it: start the actor again";
                Refusal("refused", Status::failed_precondition(status))
            }
        })?;
        tracing::info!(
            ?environments,
            left,
            "environments assigned; in lockstep every batch waits for every environment"
        );
        if inherited {
            tracing::warn!(
                ?environments,
                "another actor begins these environments anew: from here on the seed does not decide this run"
            );
        }
        Ok(Some(Environments { first: environments.start, count: environments.len() as u32 }))
    }
}
