//! A peer stays connected but does not answer for a minute. The other side notices within half a minute, and accepts the
//! peer again afterwards.

use std::time::Duration;

use anyhow::{Context as _, Result};
use comic_tests::steps::{LIMIT, leaves, the_accounting_balances_at_the_end, trains_on};
use comic_tests::system::{SMALL, System};
use tokio::time::{Instant, sleep_until};

/// The documented time in which a silent peer is noticed.
const NOTICED: Duration = Duration::from_secs(30);
/// How long a peer is stopped.
const STOPPED: Duration = Duration::from_secs(60);

#[tokio::test]
async fn a_stopped_actor_is_counted_as_lost_and_joins_again() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.start_learner(LIMIT).await?;
    let mut stopped = system.start_actor()?;
    stopped.until_log_holds("acting", LIMIT).await?;
    let mut other = system.start_actor()?;
    other.until_log_holds("acting", LIMIT).await?;
    trains_on(&mut system, "two actors' unrolls are trained on").await?;

    let until = Instant::now() + STOPPED;
    stopped.pause()?;
    let lost = |status: &comic_proto::v1::Status| status.actors.is_some_and(|actors| actors.lost == 1);
    system.until("the learner gives the stopped actor up", NOTICED, |status| lost(status).then_some(())).await?;
    trains_on(&mut system, "the other's unrolls are trained on meanwhile").await?;
    sleep_until(until).await;
    stopped.resume()?;

    stopped.until_log_holds("reconnected to the learner", LIMIT).await?;
    leaves(other).await?;
    trains_on(&mut system, "alone, it is trained on again").await?;
    leaves(stopped).await?;
    the_accounting_balances_at_the_end(system).await
}

#[tokio::test]
async fn a_stopped_learner_is_noticed_and_its_actor_joins_again() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.start_learner(LIMIT).await?;
    let mut actor = system.start_actor()?;
    actor.until_log_holds("acting", LIMIT).await?;
    trains_on(&mut system, "the actor's unrolls are trained on").await?;

    let learner = system.learner.as_ref().context("no learner")?;
    let until = Instant::now() + STOPPED;
    learner.pause()?;
    actor.until_log_holds("no connection to the learner", NOTICED).await?;
    sleep_until(until).await;
    learner.resume()?;

    actor.until_log_holds("reconnected to the learner", LIMIT).await?;
    trains_on(&mut system, "training continues").await?;
    leaves(actor).await?;
    the_accounting_balances_at_the_end(system).await
}
