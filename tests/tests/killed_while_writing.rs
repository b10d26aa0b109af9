//! A learner that is killed while it writes a checkpoint resumes from the previous one.

use std::time::Instant;

use anyhow::{Context as _, Result, ensure};
use comic_tests::steps::{LIMIT, checkpoint_in, half_written, leaves, the_accounting_balances_at_the_end, trains_on};
use comic_tests::system::{SMALL, System, metric};

/// Number of kills that must fall into the writing of a checkpoint.
const CAUGHT: usize = 3;

#[tokio::test]
async fn a_learner_killed_while_it_writes_a_checkpoint_resumes_from_the_previous_one() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.set("learner.checkpoint_seconds=0.01");
    system.start_learner(LIMIT).await?;
    let actor = system.start_actor()?;
    let run = system.run();
    let (mut caught, mut tries) = (0, 0);
    while caught < CAUGHT {
        tries += 1;
        ensure!(tries <= 50, "only {caught} kills fell into the writing of a checkpoint");
        let deadline = Instant::now() + LIMIT;
        system.until("a checkpoint is there", LIMIT, |_| checkpoint_in(&run)).await?;
        while half_written(&run) == Some(0) {
            ensure!(Instant::now() < deadline, "no checkpoint is being written");
            std::thread::yield_now();
        }
        system.learner.take().context("no learner")?.kill()?;
        // The learner may have finished the checkpoint before the kill.
        caught += half_written(&run).context("the run is gone")?;
        let whole = checkpoint_in(&run).context("the whole checkpoint is gone")?;
        system.start_learner(LIMIT).await?;
        let what = format!("the learner resumes from update {whole}");
        system.until(&what, LIMIT, |status| (metric(status, "updates") > whole as f64).then_some(())).await?;
        let log = system.learner.as_ref().context("no learner")?.log();
        ensure!(log.contains(&format!("checkpoint-{whole:010}")) && !log.contains("damaged"), "{log}");
    }
    trains_on(&mut system, "training continues").await?;
    leaves(actor).await?;
    the_accounting_balances_at_the_end(system).await
}
