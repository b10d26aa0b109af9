//! What a learner epoch begins with: the experiment, the checkpoint to resume from, and the parts made of them.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use comic_clips::{Asset, Catalogue};
use comic_experiment::{Difference, Experiment, InitialPose, TaskSpec, Unroll};
use comic_proto::{UnrollLayout, UnrollShape};
use comic_replay::{BatchOrder, Batcher, Config, Ledger, Phase};

use super::low_level::LowLevel;
use super::opening::{self, Epoch};
use crate::checkpoint::{Snapshot, Store, incompatible};
use crate::device::Backend;
use crate::error::{Error, Result};
use crate::meeting::Meeting;
use crate::options::Options;
use crate::publish::Publisher;
use crate::security::Security;
use crate::service::placement::Placement;
use crate::service::{self, Service};
use crate::train::parts::TrainerParts;

/// The trainer's parts and the service. Begins the learner epoch. Rank 0 has the `store` of the run, and tells the others what is in
/// it. What actors fetch is in the directory `files`.
pub(super) fn prepare(
    options: &Options,
    mut experiment: Experiment,
    backend: Backend,
    security: Security,
    store: Option<Store>,
    files: &Path,
    meeting: Meeting,
) -> Result<(TrainerParts, Service)> {
    let Meeting { world, addresses } = meeting;
    let newest = store.as_ref().map(Store::newest).transpose()?.flatten();
    if let Some((_, snapshot)) = &newest {
        snapshot.check_format().map_err(|error| incompatible(&options.run, error))?;
    }
    let newest = opening::share_checkpoint(&world, newest)?;
    let low_level = LowLevel::find(&mut experiment, newest.as_ref().map(|(_, snapshot)| snapshot))?;
    let catalogue = Catalogue::open(&experiment.clips)?;
    catalogue.check_joint(&experiment)?;
    opening::check_equality(&world, &experiment, &catalogue)?;
    let names = catalogue.entries().iter().map(|entry| entry.name.clone()).collect();
    let spec = TaskSpec::new(&experiment, names).map_err(|name| {
        Error::configuration(format!("tracking.observations: the tracking task has no observation `{name}`"))
    })?;
    let pose = match experiment.network.initial_pose {
        InitialPose::MidRange => vec![0.0; spec.action],
        InitialPose::ReferenceMean => catalogue.mean_action()?.iter().map(|action| *action as f32).collect(),
    };
    let resume = resumed(newest, options, &experiment, &spec)?;
    let begun = store.map(|store| begin(&store, &options.run, &experiment)).transpose()?;
    let Epoch { epoch, run: id } = opening::share_epoch(&world, begun)?;
    let ledger = match &resume {
        Some(snapshot) => accounting(snapshot).map_err(|error| incompatible(&options.run, error))?,
        None => Ledger::new(),
    };
    let ledger = ledger.part_of(world.rank(), world.size());
    let ledger = ledger.with_tasks(spec.tasks.iter().map(|task| task.name.clone()));
    let layout = Arc::new(UnrollLayout::new(UnrollShape::new(&spec, &experiment)));
    let config = batches(&experiment.share(world.size())?);
    let batcher = Batcher::new(layout, config, Phase::begin(epoch), ledger);
    let publisher = Publisher::new(epoch);
    let mut assets = assets(&catalogue, &files.join("assets"))?;
    if let Some(low_level) = &low_level {
        assets.push(low_level.offer(files, experiment.transfer.low_level.clone())?);
    }
    let service = Service::new(service::Setup {
        run: options.run.clone(),
        id,
        security,
        limits: options.limits.clone(),
        experiment: experiment.clone(),
        spec: spec.clone(),
        assets,
        batcher: batcher.clone(),
        publisher: publisher.clone(),
        quarantine: options.quarantine.clone(),
        placement: (world.size() > 1).then(|| Placement::new(world.rank(), addresses)),
    })?;
    let run = options.run.clone();
    let handle = service.trainer();
    handle.prometheus.rank.set(world.rank() as i64);
    let low_level = low_level.map(|low_level| low_level.bytes);
    let parts = TrainerParts {
        experiment,
        spec,
        pose,
        low_level,
        backend,
        world,
        run,
        epoch,
        resume,
        batcher,
        publisher,
        service: handle,
    };
    Ok((parts, service))
}

/// The files that actors may not have, cut to the clips in use.
fn assets(catalogue: &Catalogue, cuts: &Path) -> Result<Vec<Asset>> {
    catalogue.assets(Some(cuts)).or_else(|error| {
        // On a full disk for instance, or where a clip has a name that we do not write.
        tracing::warn!("actors get whole files of clips: {}", comic_proto::chain(&error));
        Ok(catalogue.assets(None)?)
    })
}

/// Begins another epoch of the run, and writes the experiment into its directory.
fn begin(store: &Store, run: &Path, experiment: &Experiment) -> Result<Epoch> {
    let epoch = store.begin_epoch()?;
    let document = run.join("experiment.toml");
    let text = experiment.to_toml()?;
    // On a full disk a write leaves the file empty, so a run that is continued without a change writes nothing.
    if std::fs::read(&document).ok().as_deref() != Some(text.as_bytes()) {
        std::fs::write(&document, text).map_err(Error::file("write", document))?;
    }
    Ok(Epoch { epoch, run: store.run()? })
}

/// The newest checkpoint, if there is one and the run may resume from it.
fn resumed(
    newest: Option<(PathBuf, Snapshot)>,
    options: &Options,
    experiment: &Experiment,
    spec: &TaskSpec,
) -> Result<Option<Snapshot>> {
    let Some((path, snapshot)) = newest else { return Ok(None) };
    check_same_experiment(experiment, spec, &snapshot, options.allow_changed)
        .map_err(|error| incompatible(&options.run, error))?;
    tracing::info!(checkpoint = %path.display(), "resuming");
    Ok(Some(snapshot))
}

/// The accounting of all unrolls up to the checkpoint.
fn accounting(snapshot: &Snapshot) -> Result<Ledger> {
    let accounting = serde_json::from_slice(snapshot.part("accounting.json")?);
    let accounting = accounting.map_err(Error::json("accounting.json of the checkpoint"))?;
    Ledger::restore(&accounting).map_err(Error::within("accounting.json of the checkpoint cannot be used"))
}

/// How the batcher makes batches.
fn batches(experiment: &Experiment) -> Config {
    let Unroll { batch, ahead, lockstep, .. } = experiment.unroll;
    let order = if lockstep { BatchOrder::Environment } else { BatchOrder::Arrival };
    Config { unrolls: batch, max_staleness: experiment.max_versions_late(), ahead, order }
}

/// Checks that a run is resumed with the experiment that it had, unless it is `allowed` to change. The budget, the intervals
/// and the numbers of threads may always change, and how a replay is kept.
fn check_same_experiment(now: &Experiment, spec: &TaskSpec, snapshot: &Snapshot, allowed: bool) -> Result<()> {
    let then = Experiment::from_toml("experiment.toml of the checkpoint", snapshot.text("experiment.toml")?)?;
    let mut now = now.clone();
    now.budget = then.budget.clone();
    now.learner = then.learner.clone();
    now.actor = then.actor.clone();
    (now.replay.save, now.replay.memory_mib) = (then.replay.save, then.replay.memory_mib);
    // Only what is there counts, not where it is.
    now.transfer.low_level.clone_from(&then.transfer.low_level);
    let changed = |Difference { field, ours, theirs }| format!("{field} was {ours} and is {theirs}");
    let mut changes: Vec<String> = then.differences(&now)?.into_iter().map(changed).collect();
    let task = serde_json::from_slice::<TaskSpec>(snapshot.part("task.json")?);
    let task = task.map_err(Error::json("task.json of the checkpoint"))?;
    if changes.is_empty() && task != *spec {
        changes.push("the clips, the observations or the rewards are different".into());
    }
    if changes.is_empty() {
        return Ok(());
    }
    let changes = changes.join("; ");
    if allowed {
        tracing::warn!("the run continues with another experiment: {changes}");
        return Ok(());
    }
    Err(Error::configuration(format!(
        "it was made by another experiment ({changes}): give another --run, the old values, or --allow-changed"
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resume(change: impl FnOnce(&mut Experiment), allowed: bool) -> Result<()> {
        let then = Experiment::default();
        let spec = TaskSpec::new(&then, vec!["walk".into()]).unwrap();
        let mut snapshot = Snapshot::default();
        snapshot.parts.insert("experiment.toml".into(), then.to_toml()?.into_bytes());
        snapshot.parts.insert("task.json".into(), serde_json::to_vec(&spec).unwrap());
        let mut now = then;
        change(&mut now);
        check_same_experiment(&now, &spec, &snapshot, allowed)
    }

    #[test]
    fn a_changed_experiment_is_refused_with_every_changed_field() {
        let change = |experiment: &mut Experiment| {
            experiment.optimiser.beta1 = 0.5;
            experiment.network.latent.beta = 0.25;
        };
        let refused = resume(change, false).unwrap_err();
        assert_eq!(refused.exit_code(), 2);
        let message = refused.to_string();
        for part in ["optimiser.beta1 was", "is 0.5", "network.latent.beta was", "is 0.25", "--allow-changed"] {
            assert!(message.contains(part), "no `{part}` in {message}");
        }
        assert!(resume(change, true).is_ok());
    }

    #[test]
    fn budget_intervals_and_threads_may_always_change() {
        let change = |experiment: &mut Experiment| {
            experiment.budget.minutes = 7.0;
            experiment.learner.checkpoint_seconds = 8.0;
            experiment.actor.threads = 9;
        };
        assert!(resume(change, false).is_ok());
    }

    #[test]
    fn a_low_level_may_move_but_not_change() {
        assert!(resume(|experiment| experiment.transfer.low_level = "elsewhere".into(), false).is_ok());
        let refused = resume(|experiment| experiment.transfer.sha256 = "1".repeat(64), false).unwrap_err().to_string();
        assert!(refused.contains("transfer.sha256 was"), "{refused}");
    }
}
