//! The system clock is set while a run trains: no waiting, timeout or measurement depends on it.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use comic_proto::v1::Status;
use comic_tests::lockstep::{ALL, SLOW_BYTES_PER_SECOND, UPDATES, final_state, final_state_of, is_over, lockstep};
use comic_tests::process::Process;
use comic_tests::relay::Relay;
use comic_tests::repository::root;
use comic_tests::steps::{LIMIT, leaves, now, parameters_arrive, the_accounting_balances_at_the_end, trains_on};
use comic_tests::system::{SMALL, System, metric};

/// Far enough that every line of a log shows another year.
const JUMP: i64 = 400 * 86_400;

#[tokio::test]
async fn nothing_is_lost_when_the_clock_is_set() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let mut system = System::new(&SMALL)?;
    let clock = clock_of(&mut system, directory.path())?;
    system.start_learner(LIMIT).await?;
    let mut actor = system.start_actor()?;
    actor.until_log_holds("acting", LIMIT).await?;
    trains_on(&mut system, "the actor's unrolls are trained on").await?;
    for jump in [JUMP, -JUMP] {
        fs::write(&clock, jump.to_string())?;
        says_another_year(&mut actor, jump).await?;
        trains_on(&mut system, "training continues").await?;
        parameters_arrive(&mut system, "new parameters arrive").await?;
        let Status { actors, .. } = now(&mut system).await?;
        let actors = actors.context("no actors")?;
        ensure!((actors.alive, actors.lost) == (1, 0), "after a jump of {jump} s: {actors:?}");
    }
    let (actor_log, learner_log) = (actor.log(), system.learner.as_ref().context("no learner")?.log());
    ensure!(!actor_log.contains("no connection"), "{actor_log}");
    ensure!(!learner_log.contains("ERROR"), "{learner_log}");
    leaves(actor).await?;
    the_accounting_balances_at_the_end(system).await
}

#[tokio::test]
async fn a_changed_clock_does_not_change_the_parameters() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let mut system = lockstep(&[])?;
    // The learner logs at least one line for every update, so each jump shows in a line.
    system.log_level = Some("info,comic_learner=debug".into());
    let clock = clock_of(&mut system, directory.path())?;
    system.start_learner(LIMIT).await?;
    let relay = Relay::start(system.address(), SLOW_BYTES_PER_SECOND).await?;
    let mut actors = [system.start_actor_of(ALL, &relay.url)?];
    for (updates, jump) in [(1.0, JUMP), (3.0, -JUMP)] {
        let what = format!("{updates} updates");
        let done = |status: &Status| Some(metric(status, "updates")).filter(|done| *done >= updates);
        let done = system.until(&what, LIMIT, done).await?;
        ensure!(done < UPDATES as f64, "the clock was set too late: after {done} updates");
        fs::write(&clock, jump.to_string())?;
    }
    let log = is_over(&mut system, &mut actors).await?;
    ensure!([JUMP, -JUMP].iter().all(|jump| says_year_after(&log, *jump)), "the learner did not see both jumps: {log}");
    ensure!(final_state(&system)? == final_state_of(&[ALL], &[]).await?, "a changed clock changed the parameters");
    Ok(())
}

/// Gives the programs of a system their own clock. Returns the file that holds its offset in seconds.
fn clock_of(system: &mut System, directory: &Path) -> Result<PathBuf> {
    let (library, clock) = (directory.join("clock.so"), directory.join("clock"));
    compile(&library)?;
    fs::write(&clock, "0")?;
    system.clock = Some((library, clock.clone()));
    Ok(clock)
}

/// Checks that the jump had an effect: lines of the log show the new year.
async fn says_another_year(actor: &mut Process, jump: i64) -> Result<()> {
    actor.until_log("another year", LIMIT, |log| says_year_after(log, jump)).await
}

fn says_year_after(log: &str, jump: i64) -> bool {
    let year = (time::OffsetDateTime::now_utc() + time::Duration::seconds(jump)).year();
    log.contains(&format!("\n{year}-"))
}

/// Uses the C compiler that Rust links with.
fn compile(library: &Path) -> Result<()> {
    let source = root().join("tests/fixtures/jumping_clock.c");
    let output = Command::new("cc").args(["-shared", "-fPIC", "-O1", "-o"]).arg(library).arg(&source).output();
    let output = output.context("cannot start `cc`, which Rust links with")?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Ok(())
}
