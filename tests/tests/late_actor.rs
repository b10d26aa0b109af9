//! An actor that comes when the run is over: it is told so, and is done.

use anyhow::{Context as _, Result, ensure};
use comic_tests::steps::LIMIT;
use comic_tests::system::{SMALL, System};

/// Seconds after which a learner whose actors were there when the run ended has long gone.
const LATE: f64 = 3.0;

#[tokio::test]
async fn an_actor_that_comes_when_the_run_is_over_is_told_so() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.set("budget.updates=5");
    system.start_learner(LIMIT).await?;
    let mut actor = system.start_actor()?;
    ends_well(&mut actor).await.context("the run's own actor")?;
    ends_well(system.learner.as_mut().context("no learner")?).await.context("the learner")?;

    // A supervisor starts both again, the learner first.
    system.start_learner(LIMIT).await?;
    system.until("the learner waits", LIMIT, |status| (status.uptime_seconds > LATE).then_some(())).await?;
    ends_well(&mut system.start_actor()?).await.context("the late actor")?;
    ends_well(system.learner.as_mut().context("no learner")?).await.context("the learner, again")
}

async fn ends_well(process: &mut comic_tests::process::Process) -> Result<()> {
    let status = process.until_it_ends(LIMIT).await?;
    ensure!(status.success(), "it ended with {status}: {}", process.log());
    Ok(())
}
