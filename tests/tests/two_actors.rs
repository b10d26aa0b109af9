//! One learner and two actors as real processes with real sockets. Each of them is killed once, and the run survives.

use anyhow::{Result, ensure};
use comic_tests::steps::{
    LIMIT, kill_and_restart_the_learner, leaves, parameters_arrive, the_accounting_balances_at_the_end, trains_on,
};
use comic_tests::system::{SMALL, System};

#[tokio::test]
async fn two_actors_and_a_learner_survive_kills_and_the_accounting_balances() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    let first = system.start_learner(LIMIT).await?;

    // Only the first actor's unrolls are there to train on.
    let killed = system.start_actor()?;
    trains_on(&mut system, "the first actor's unrolls are trained on").await?;
    parameters_arrive(&mut system, "the first actor acts with new parameters").await?;

    let mut second = system.start_actor()?;
    second.until_log_holds("joined the learner", LIMIT).await?;
    killed.kill()?;
    trains_on(&mut system, "the second actor's unrolls are trained on after the first was killed").await?;
    parameters_arrive(&mut system, "the second actor acts with new parameters").await?;

    let mut third = system.start_actor()?;
    third.until_log_holds("joined the learner", LIMIT).await?;
    trains_on(&mut system, "training continues with a new actor").await?;

    let resumed = kill_and_restart_the_learner(&mut system).await?;
    ensure!(resumed.learner_epoch > first.learner_epoch, "a restarted learner must begin a new epoch");
    for actor in [&mut second, &mut third] {
        actor.until_log_holds(&format!("learner_epoch={}", resumed.learner_epoch), LIMIT).await?;
    }
    leaves(second).await?;
    trains_on(&mut system, "the third actor's unrolls are trained on after the restart").await?;
    parameters_arrive(&mut system, "the third actor acts with the restarted learner's parameters").await?;
    leaves(third).await?;
    the_accounting_balances_at_the_end(system).await
}
