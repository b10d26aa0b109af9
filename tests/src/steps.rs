//! Steps that several whole-system tests take with a learner and its actors.

use std::fs;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use comic_proto::v1::{Accounting, Status};

use crate::accounting::balance;
use crate::process::Process;
use crate::system::{Answered, System, metric};

/// Long enough for the slowest machine. A step ends as soon as its condition holds.
pub const LIMIT: Duration = Duration::from_secs(120);
/// The documented time in which an actor ends after SIGTERM.
const ACTOR_LEAVES: Duration = Duration::from_secs(5);
/// The documented time in which a learner ends after SIGTERM.
const LEARNER_LEAVES: Duration = Duration::from_secs(30);
/// Most bytes that a learner of the smallest experiment needs for training and a few actors, with the memory that an
/// allocator keeps.
const MEMORY: u64 = 300_000_000;
/// More unrolls than a dead actor can have in flight: two batches in the batcher, one in training, its window.
const BEYOND_WHAT_IS_LEFT: u64 = 200;
/// More versions than an actor may lag behind.
const VERSIONS: f64 = 30.0;

/// The accounting of a status.
pub fn accounting(status: &Status) -> Accounting {
    status.accounting.unwrap_or_default()
}

/// The learner's status. A learner that is too busy for an answer is asked again.
///
/// # Errors
/// When the learner does not answer in time.
pub async fn now(system: &mut System) -> Result<Status> {
    system.until("an answer", LIMIT, |status| Some(status.clone())).await
}

/// Waits until more unrolls are trained than a dead actor can have in flight.
///
/// # Errors
/// When this does not happen in time.
pub async fn trains_on(system: &mut System, what: &str) -> Result<()> {
    let before = accounting(&now(system).await?).trained;
    system.until(what, LIMIT, |status| (accounting(status).trained >= before + BEYOND_WHAT_IS_LEFT).then_some(())).await
}

/// The learner's log level for [`trains_on_each`]: a line for every unroll that is trained on.
pub const EVERY_UNROLL: &str = "info,comic_learner::train::reports=trace";

/// Waits until the learner has trained on an unroll of each of these actors that was made with a version much newer than the
/// newest one now. So every actor works and gets new parameters; totals would grow with one of them alone. The learner needs the
/// log level [`EVERY_UNROLL`].
///
/// # Errors
/// When this does not happen in time.
pub async fn trains_on_each(system: &mut System, actors: &[Process], what: &str) -> Result<()> {
    let wanted = metric(&now(system).await?, "version") + VERSIONS;
    let actors = actors.iter().map(index).collect::<Result<Vec<_>>>()?;
    let learner = system.learner.as_mut().context("no learner")?;
    for actor in actors {
        let what = format!("{what}: an unroll of actor {actor} of version {wanted} or newer is trained on");
        learner
            .until_log(&what, LIMIT, |log| newest_trained(log, actor).is_some_and(|newest| newest >= wanted))
            .await?;
    }
    Ok(())
}

/// The number that the learner gave to an actor that has joined.
fn index(actor: &Process) -> Result<u64> {
    let log = actor.log();
    let line = log.lines().rfind(|line| line.contains("joined the learner")).context("the actor has not joined")?;
    Ok(field(line, "actor").with_context(|| format!("no number in {line}"))? as u64)
}

/// The version with which the newest trained unroll of an actor was made, from the learner's log.
fn newest_trained(log: &str, actor: u64) -> Option<f64> {
    let trained = format!("trained on actor={actor} ");
    // The last line may be half written.
    let (whole, _) = log.rsplit_once('\n')?;
    field(whole.lines().rfind(|line| line.contains(&trained))?, "version")
}

/// A number that a line of a log names.
fn field(line: &str, name: &str) -> Option<f64> {
    let (_, rest) = line.rsplit_once(&format!(" {name}="))?;
    rest.split(' ').next()?.parse().ok()
}

/// Waits for new versions and checks that trained unrolls are only a few versions old: actors used new parameters.
///
/// # Errors
/// When this does not happen in time.
pub async fn parameters_arrive(system: &mut System, what: &str) -> Result<()> {
    let before = metric(&now(system).await?, "version");
    system
        .until(what, LIMIT, |status| {
            let grown = metric(status, "version") - before;
            (grown >= VERSIONS && metric(status, "unroll_age") < grown / 2.0).then_some(())
        })
        .await
}

/// Kills the learner while it trains. The next learner resumes from a checkpoint.
///
/// # Errors
/// When this does not happen in time.
pub async fn kill_and_restart_the_learner(system: &mut System) -> Result<Status> {
    let updates = newest_checkpoint(system).await?;
    system.learner.take().context("no learner")?.kill()?;
    ensure!(system.status().await.is_err(), "a killed learner does not answer");
    let status = system.start_learner(LIMIT).await?;
    let what = format!("the restarted learner resumes from update {updates}");
    system.until(&what, LIMIT, |status| (metric(status, "updates") > updates as f64).then_some(())).await?;
    let resumed = system.learner.as_ref().context("no learner")?.log();
    ensure!(!resumed.contains("damaged"), "the checkpoint did not verify: {resumed}");
    Ok(status)
}

/// Waits for a whole checkpoint and returns the updates of the newest one.
///
/// # Errors
/// When there is none in time.
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

/// Number of checkpoints of a run that are not complete: they are being written, or were when the learner died.
pub fn half_written(run: &Path) -> Option<usize> {
    let names = fs::read_dir(run.join("checkpoints")).ok()?.flatten().map(|entry| entry.file_name());
    Some(names.filter(|name| name.to_string_lossy().starts_with(".checkpoint-")).count())
}

/// Asks an actor to end. Its exit code must be 1, since the run is not over: a supervisor that counts exit code 0 as done
/// must not count this actor.
///
/// # Errors
/// When the actor does not end in time, or with another code.
pub async fn leaves(actor: Process) -> Result<()> {
    let status = actor.terminate(ACTOR_LEAVES).await?;
    ensure!(status.code() == Some(1), "an actor after SIGTERM ended with {status}");
    Ok(())
}

/// Checks the accounting after the actors have ended: each unroll was trained on once, dropped for a counted reason, or is
/// in an open batch. Every acknowledged unroll is counted, and no other one. Also checks that the learner freed the memory
/// of its actors.
///
/// # Errors
/// When one of these does not hold.
pub async fn the_accounting_balances_at_the_end(mut system: System) -> Result<()> {
    let accounting = accounting(&now(&mut system).await?);
    ensure!(balance(&accounting), "{accounting:?}");
    ensure!(accounting.dropped_invalid == 0, "an actor sent an invalid unroll: {accounting:?}");
    let Answered { unrolls, all } = system.answered()?;
    ensure!(unrolls <= accounting.produced, "{unrolls} unrolls were acknowledged, fewer were counted: {accounting:?}");
    ensure!(
        !all || unrolls == accounting.produced,
        "actors made only {unrolls} unrolls, more were counted: {accounting:?}"
    );
    let grown = system.grown()?;
    ensure!(grown < MEMORY, "the learner has {grown} bytes more than before the first actor");
    let learner = system.learner.take().context("no learner")?;
    let status = learner.terminate(LEARNER_LEAVES).await?;
    ensure!(status.code() == Some(4), "a learner after SIGTERM ended with {status}");
    Ok(())
}
