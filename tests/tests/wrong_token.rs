//! An actor with a wrong token tries for three minutes, or for `--give-up-after` if that is shorter, and ends with exit code 2.
//! An actor that had joined before waits for the renewed token.

use std::fs;

use anyhow::{Context, Result, ensure};
use comic_proto::Access;
use comic_tests::steps::{LIMIT, trains_on};
use comic_tests::system::{SMALL, System};

#[tokio::test]
async fn a_wrong_token_ends_an_actor_unless_it_is_renewed_in_time_or_it_had_joined_before() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let [accepted, shown, wrong] = ["accepted", "shown", "wrong"].map(|name| directory.path().join(name));
    fs::write(&accepted, "first-token\n")?;
    fs::write(&shown, "first-token\n")?;
    fs::write(&wrong, "wrong-token\n")?;
    let accepted_path = accepted.display().to_string();
    let mut system = System::new(&[&SMALL[..], &["--token-file", &accepted_path]].concat())?;
    system.access = Access { token_file: Some(shown.clone()), ..Access::default() };
    system.start_learner(LIMIT).await?;

    for access in [Access { token_file: Some(wrong.clone()), ..Access::default() }, Access::default()] {
        let mut refused = system.start_actor_with(&access, |actor| {
            actor.args(["--give-up-after", "1"]);
        })?;
        let status = refused.until_it_ends(LIMIT).await?;
        ensure!(status.code() == Some(2), "{status}: {}", refused.log());
        ensure!(refused.log().contains("--token-file"), "the remedy is not named: {}", refused.log());
    }

    let mut early =
        system.start_actor_with(&Access { token_file: Some(wrong.clone()), ..Access::default() }, |_| {})?;
    early.until_log_holds("does not accept this process", LIMIT).await?;
    fs::write(&wrong, "first-token\n")?;
    early.until_log_holds("joined the learner", LIMIT).await?;
    trains_on(&mut system, "the unrolls of the actor with the renewed token are trained on").await?;

    let mut actor = system.start_actor()?;
    actor.until_log_holds("joined the learner", LIMIT).await?;
    // The learner's token changes; the actor's changes later.
    fs::write(&accepted, "second-token\n")?;
    system.access = Access { token_file: Some(accepted), ..Access::default() };
    system.learner.take().context("no learner")?.kill()?;
    let restarted = system.start_learner(LIMIT).await?;
    actor.until_log_holds("another token", LIMIT).await?;
    fs::write(&shown, "second-token\n")?;
    actor.until_log_holds(&format!("learner_epoch={}", restarted.learner_epoch), LIMIT).await?;
    trains_on(&mut system, "the unrolls of the actor with the second token are trained on").await
}
