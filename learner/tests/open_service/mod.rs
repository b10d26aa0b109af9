//! The service of a trainer that is fed without a network.

use std::path::Path;

use comic_experiment::{Experiment, TaskSpec};
use comic_learner::publish::Publisher;
use comic_learner::security::{ConnectionLimits, Security};
use comic_learner::service::quarantine::QuarantineArguments;
use comic_learner::service::{Service, Setup};
use comic_replay::Batcher;

/// A service of run `id` without access control.
pub(crate) fn open_service(
    run: &Path,
    id: u64,
    experiment: &Experiment,
    spec: &TaskSpec,
    batcher: &Batcher,
    publisher: &Publisher,
) -> Service {
    Service::new(Setup {
        run: run.to_path_buf(),
        id,
        security: Security::default(),
        limits: ConnectionLimits::default(),
        experiment: experiment.clone(),
        spec: spec.clone(),
        assets: Vec::new(),
        batcher: batcher.clone(),
        publisher: publisher.clone(),
        quarantine: QuarantineArguments::default(),
        placement: None,
    })
    .unwrap()
}
