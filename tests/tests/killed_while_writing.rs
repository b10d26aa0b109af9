//! A learner that is killed in the middle of writing a checkpoint goes on from the one before.

use std::time::Instant;

use anyhow::{Context as _, Result, ensure};
use comic_tests::steps::{LIMIT, checkpoint_in, half_written, leaves, the_accounting_balances_at_the_end, trains_on};
use comic_tests::system::{SMALL, System, metric};

/// How often it is caught in the act.
const CAUGHT: usize = 3;

#[tokio::test]
async fn a_learner_killed_while_it_writes_a_checkpoint_goes_on_from_the_one_before() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.set("learner.checkpoint_seconds=0.01");
    system.start_learner(LIMIT).await?;
    let actor = system.start_actor()?;
    let run = system.run();
    let (mut caught, mut tries) = (0, 0);
    while caught < CAUGHT {
        tries += 1;
        ensure!(tries <= 50, "caught {caught} times only");
        let deadline = Instant::now() + LIMIT;
        system.until("a checkpoint is there", LIMIT, |_| checkpoint_in(&run)).await?;
        while half_written(&run) == Some(0) {
            ensure!(Instant::now() < deadline, "no checkpoint is being written");
            std::thread::yield_now();
        }
        system.learner.take().context("no learner")?.kill()?;
        // Between the look and the kill it may have got done.
        caught += half_written(&run).context("the run is gone")?;
        let whole = checkpoint_in(&run).context("the whole checkpoint is gone")?;
        system.start_learner(LIMIT).await?;
        let what = format!("it goes on from update {whole}");
        system.until(&what, LIMIT, |status| (metric(status, "updates") > whole as f64).then_some(())).await?;
        let log = system.learner.as_ref().context("no learner")?.log();
        ensure!(log.contains(&format!("checkpoint-{whole:010}")) && !log.contains("damaged"), "{log}");
    }
    trains_on(&mut system, "training goes on").await?;
    leaves(actor).await?;
    the_accounting_balances_at_the_end(system).await
}
