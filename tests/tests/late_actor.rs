//! An actor that joins after the end of a run learns so and ends with 0.

use anyhow::{Context as _, Result, ensure};
use comic_tests::steps::LIMIT;
use comic_tests::system::{SMALL, System};

/// Seconds. A learner whose actors were connected when the run ended has ended long before.
const LATE: f64 = 3.0;

#[tokio::test]
async fn an_actor_that_joins_after_the_end_of_a_run_ends_with_0() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.set("budget.updates=5");
    system.start_learner(LIMIT).await?;
    let mut actor = system.start_actor()?;
    ends_well(&mut actor).await.context("the run's own actor")?;
    ends_well(system.learner.as_mut().context("no learner")?).await.context("the learner")?;

    // A supervisor restarts both, the learner first.
    system.start_learner(LIMIT).await?;
    system.until("the learner waits", LIMIT, |status| (status.uptime_seconds > LATE).then_some(())).await?;
    ends_well(&mut system.start_actor()?).await.context("the late actor")?;
    ends_well(system.learner.as_mut().context("no learner")?).await.context("the learner, again")
}

async fn ends_well(process: &mut comic_tests::process::Process) -> Result<()> {
    let status = process.until_it_ends(LIMIT).await?;
    ensure!(status.success(), "the process ended with {status}: {}", process.log());
    Ok(())
}
