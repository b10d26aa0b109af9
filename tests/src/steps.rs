//! What whole-system tests make a learner and its actors go through.

use std::fs;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use comic_proto::v1::{Accounting, Status};

use crate::process::Process;
use crate::system::{Answered, System, balance, metric};

/// Long enough for the slowest machine; no step waits longer than it needs.
pub const LIMIT: Duration = Duration::from_secs(120);
/// What an actor promises.
const ACTOR_LEAVES: Duration = Duration::from_secs(5);
/// What a learner promises.
const LEARNER_LEAVES: Duration = Duration::from_secs(30);
/// Bytes that a learner of the smallest experiment takes at most for training and a handful of actors, with what an
/// allocator keeps.
const MEMORY: u64 = 300_000_000;
/// More unrolls than a dead actor can have left behind: two batches in the batcher, one in training, its window.
const BEYOND_WHAT_IS_LEFT: u64 = 200;
/// More versions than actors may lag behind.
const VERSIONS: f64 = 30.0;

/// The accounting of a status.
pub fn accounting(status: &Status) -> Accounting {
    status.accounting.unwrap_or_default()
}

/// A status; a learner that is too busy for an answer is asked again.
///
/// # Errors
/// When it does not answer, in time.
pub async fn now(system: &mut System) -> Result<Status> {
    system.until("an answer", LIMIT, |status| Some(status.clone())).await
}

/// Training goes beyond whatever an actor that is gone can have left behind.
///
/// # Errors
/// When it does not, in time.
pub async fn trains_on(system: &mut System, what: &str) -> Result<()> {
    let before = accounting(&now(system).await?).trained;
    system.until(what, LIMIT, |status| (accounting(status).trained >= before + BEYOND_WHAT_IS_LEFT).then_some(())).await
}

/// While versions go up, what is trained on stays only a few versions old: it was made with new parameters.
///
/// # Errors
/// When it does not, in time.
pub async fn parameters_arrive(system: &mut System, what: &str) -> Result<()> {
    let before = metric(&now(system).await?, "version");
    system
        .until(what, LIMIT, |status| {
            let grown = metric(status, "version") - before;
            (grown >= VERSIONS && metric(status, "unroll_age") < grown / 2.0).then_some(())
        })
        .await
}

/// Kills the learner in mid-stream; the next one goes on from a checkpoint.
///
/// # Errors
/// When it does not, in time.
pub async fn kill_and_restart_the_learner(system: &mut System) -> Result<Status> {
    let updates = newest_checkpoint(system).await?;
    system.learner.take().context("no learner")?.kill()?;
    ensure!(system.status().await.is_err(), "a killed learner does not answer");
    let status = system.start_learner(LIMIT).await?;
    let what = format!("the restarted learner goes on from update {updates}");
    system.until(&what, LIMIT, |status| (metric(status, "updates") > updates as f64).then_some(())).await?;
    let resumed = system.learner.as_ref().context("no learner")?.log();
    ensure!(!resumed.contains("damaged"), "the checkpoint did not verify: {resumed}");
    Ok(status)
}

/// Updates of the newest whole checkpoint, once there is one.
///
/// # Errors
/// When there is none, in time.
pub async fn newest_checkpoint(system: &mut System) -> Result<u64> {
    let run = system.run();
    system.until("a checkpoint is written", LIMIT, |_| checkpoint_in(&run)).await
}

/// Updates of the newest whole checkpoint of a run, if there is one.
pub fn checkpoint_in(run: &Path) -> Option<u64> {
    let entries = fs::read_dir(run.join("checkpoints")).ok()?.flatten();
    let names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
    names.filter_map(|name| name.strip_prefix("checkpoint-")?.parse().ok()).max()
}

/// How many checkpoints of a run are being written, or were when the learner died.
pub fn half_written(run: &Path) -> Option<usize> {
    let names = fs::read_dir(run.join("checkpoints")).ok()?.flatten().map(|entry| entry.file_name());
    Some(names.filter(|name| name.to_string_lossy().starts_with(".checkpoint-")).count())
}

/// An actor leaves when it is asked to, with 1: it was told to stop before the run was over, and whoever counts what ends
/// with 0 as done must not count it.
///
/// # Errors
/// When it does not, or in another way.
pub async fn leaves(actor: Process) -> Result<()> {
    let status = actor.terminate(ACTOR_LEAVES).await?;
    ensure!(status.code() == Some(1), "an actor that is asked to leave leaves with {status}");
    Ok(())
}

/// Nobody produces any more: what was produced is trained on once, dropped for a counted reason, or in an open batch. Nothing
/// that an actor was answered about is missing there, and nothing is there that none made. The learner gave back what memory
/// it took.
///
/// # Errors
/// When it is not so.
pub async fn the_accounting_balances_at_the_end(mut system: System) -> Result<()> {
    let accounting = accounting(&now(&mut system).await?);
    ensure!(balance(&accounting), "{accounting:?}");
    ensure!(accounting.dropped_invalid == 0, "no actor sends what is invalid: {accounting:?}");
    let Answered { unrolls, all } = system.answered()?;
    ensure!(unrolls <= accounting.produced, "actors were answered about {unrolls} unrolls: {accounting:?}");
    ensure!(!all || unrolls == accounting.produced, "actors made no more than {unrolls} unrolls: {accounting:?}");
    let grown = system.grown()?;
    ensure!(grown < MEMORY, "the learner has {grown} bytes more than before anybody came");
    let learner = system.learner.take().context("no learner")?;
    let status = learner.terminate(LEARNER_LEAVES).await?;
    ensure!(status.success(), "a learner that is asked to leave leaves with {status}");
    Ok(())
}
