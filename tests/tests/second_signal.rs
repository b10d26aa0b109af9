//! A second signal ends a learner at once, also while libtorch computes.

use std::time::Duration;

use anyhow::{Context, Result, ensure};
use comic_tests::system::{SMALL, System};

const LIMIT: Duration = Duration::from_secs(120);
/// Far less than the update takes.
const AT_ONCE: Duration = Duration::from_secs(20);

#[tokio::test]
async fn a_second_signal_ends_a_learner_in_the_middle_of_an_update() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    // An update of many minutes.
    system.set("vmpo.gradient_steps=10000000");
    system.log_level = Some("info,comic_learner=debug".into());
    system.start_learner(LIMIT).await?;
    let _actor = system.start_actor()?;

    let mut learner = system.learner.take().context("no learner")?;
    // Before that, a first signal ends the learner by itself: there is no update to finish. A span's name ends with a colon;
    // without it the field `gradient_steps` of the first metrics would be taken for the span.
    learner.until_log_holds("gradient_step:", LIMIT).await?;
    learner.ask_to_end()?;
    learner.until_log_holds("stopping after this update", LIMIT).await?;
    learner.ask_to_end()?;
    let status = learner.until_it_ends(AT_ONCE).await?;
    ensure!(status.code() == Some(1), "{status}: {}", learner.log());
    ensure!(learner.log().contains("stopped by a second signal"), "{}", learner.log());
    Ok(())
}
