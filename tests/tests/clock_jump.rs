//! Somebody sets the clock on the wall: nothing that waits, expires or is measured goes by it.

use std::fs;
use std::path::Path;
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use comic_proto::v1::Status;
use comic_tests::process::Process;
use comic_tests::repository::root;
use comic_tests::steps::{LIMIT, leaves, now, parameters_arrive, the_books_balance_at_the_end, trains_on};
use comic_tests::system::{SMALL, System};

/// Far enough for another year in every line of a log.
const JUMP: i64 = 400 * 86_400;

#[tokio::test]
async fn nothing_is_lost_when_the_clock_is_set() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let (library, clock) = (directory.path().join("clock.so"), directory.path().join("clock"));
    compile(&library)?;
    fs::write(&clock, "0")?;
    let mut system = System::new(&SMALL)?;
    system.clock = Some((library, clock.clone()));
    system.start_learner(LIMIT).await?;
    let mut actor = system.start_actor()?;
    actor.until_log_holds("acting", LIMIT).await?;
    trains_on(&mut system, "the actor's unrolls are trained on").await?;
    for jump in [JUMP, -JUMP] {
        fs::write(&clock, jump.to_string())?;
        says_another_year(&mut actor, jump).await?;
        trains_on(&mut system, "training goes on").await?;
        parameters_arrive(&mut system, "new parameters arrive").await?;
        let Status { actors, .. } = now(&mut system).await?;
        let actors = actors.context("no actors")?;
        ensure!((actors.alive, actors.lost) == (1, 0), "after a jump of {jump} s: {actors:?}");
    }
    let (actor_log, learner_log) = (actor.log(), system.learner.as_ref().context("no learner")?.log());
    ensure!(!actor_log.contains("no connection"), "{actor_log}");
    ensure!(!learner_log.contains("ERROR"), "{learner_log}");
    leaves(actor).await?;
    the_books_balance_at_the_end(system).await
}

/// That the jump was seen at all: lines of the log bear the new year.
async fn says_another_year(actor: &mut Process, jump: i64) -> Result<()> {
    let year = (time::OffsetDateTime::now_utc() + time::Duration::seconds(jump)).year();
    actor.until_log_holds(&format!("\n{year}-"), LIMIT).await
}

/// With the compiler that Rust links with.
fn compile(library: &Path) -> Result<()> {
    let source = root().join("tests/fixtures/jumping_clock.c");
    let output = Command::new("cc").args(["-shared", "-fPIC", "-O1", "-o"]).arg(library).arg(&source).output();
    let output = output.context("cannot start `cc`, which Rust links with")?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Ok(())
}
