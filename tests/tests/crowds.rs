//! Hundreds and thousands of simulated actors: one process runs many, each with its own connection.

use std::process::Command;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use comic_proto::v1::Status;
use comic_tests::steps::{
    LIMIT, accounting, kill_and_restart_the_learner, newest_checkpoint, now, the_accounting_balances_at_the_end,
    trains_on,
};
use comic_tests::system::{SMALL, System, program};
use serde_json::Value;

const MEGABYTE: u64 = 1_000_000;
/// Time in which hundreds of connections are made and counted, even on a busy machine.
const CROWD_LIMIT: Duration = Duration::from_secs(120);

#[tokio::test]
async fn a_hundred_times_as_many_actors_come_and_leave() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    // Smaller unrolls: the limit below is for memory that is lost, and not for what the allocator keeps.
    system.set("vmpo.action_gradient=0");
    system.set("tracking.reference_steps=[1]");
    system.start_learner(LIMIT).await?;
    let few = system.start_crowd(5)?;
    trains_on(&mut system, "five actors' unrolls are trained on").await?;
    let mut left = Vec::new();
    for _ in 0..3 {
        let many = system.start_crowd(495)?;
        actors(&mut system, 500).await?;
        trains_on(&mut system, "five hundred actors' unrolls are trained on").await?;
        many.kill()?;
        actors(&mut system, 5).await?;
        trains_on(&mut system, "the five that stayed are trained on").await?;
        left.push(system.learner.as_ref().context("no learner")?.resident()?);
    }
    // The allocator keeps the memory of the first crowd for the next one, but cannot always reuse all of it.
    ensure!(
        left[2] < left[0] + 60 * MEGABYTE,
        "each actor that left still takes 60 KB: bytes after each crowd {left:?}"
    );
    drop(few);
    the_accounting_balances_at_the_end(system).await
}

#[tokio::test]
async fn fifty_actors_come_back_to_a_learner_that_was_killed() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.set("learner.checkpoint_seconds=5");
    system.start_learner(LIMIT).await?;
    let crowd = system.start_crowd(50)?;
    actors(&mut system, 50).await?;
    trains_on(&mut system, "fifty actors' unrolls are trained on").await?;
    newest_checkpoint(&mut system).await?;
    trains_on(&mut system, "and some after a checkpoint").await?;
    let before = accounting(&now(&mut system).await?).trained;
    let resumed = accounting(&kill_and_restart_the_learner(&mut system).await?).trained;
    actors(&mut system, 50).await?;
    trains_on(&mut system, "fifty actors' unrolls are trained on again").await?;
    // The accounting names the unrolls that were trained on after the checkpoint, once every actor has sent its next number.
    let counted = |status: &Status| accounting(status).dropped_lost_at_restart >= before.saturating_sub(resumed);
    system.until("what the learner lost is counted", LIMIT, |status| counted(status).then_some(())).await?;
    drop(crowd);
    the_accounting_balances_at_the_end(system).await
}

async fn actors(system: &mut System, wanted: u64) -> Result<()> {
    let what = format!("{wanted} actors are there");
    let alive = |status: &Status| status.actors.is_some_and(|actors| actors.alive == wanted);
    system.until(&what, CROWD_LIMIT, |status| alive(status).then_some(())).await
}

#[test]
fn a_thousand_readers_that_stop_cost_less_than_60_mb_and_delay_no_one() -> Result<()> {
    let output = Command::new(program("comic-bench-learner")?)
        .args(["stalled", "--connections", "1000", "--parameters", "2000000"])
        .env("RUST_LOG", "warn")
        .output()?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let figure: Value = serde_json::from_slice(&output.stdout).context("no figure")?;
    let number = |name: &str| figure[name].as_f64().with_context(|| format!("no `{name}` in {figure}"));
    ensure!(number("stalled")? == 1000.0, "{figure}");
    ensure!(number("value")? < 60.0, "more than 60 MB: {figure}");
    // This is the median. A version that no reader can finish loses its place after five seconds, once.
    ensure!(number("a_healthy_reader_waits_s")? < 5.0, "{figure}");
    Ok(())
}
