//! An expired certificate refuses actors only until it is renewed. Neither the learner nor the actor restarts.

use std::time::Duration;

use anyhow::{Result, ensure};
use comic_tests::certificates::Authority;
use comic_tests::system::{SMALL, System};

const LIMIT: Duration = Duration::from_secs(120);

#[tokio::test]
async fn actors_wait_for_the_renewed_certificate() -> Result<()> {
    let authority = Authority::new()?;
    authority.issue("server", 60)?;
    authority.issue("client", -60)?;
    let options = [authority.serving(), authority.asking()].concat();
    let options: Vec<&str> = SMALL.into_iter().chain(options.iter().map(String::as_str)).collect();
    let mut system = System::new(&options)?;
    authority.issue("own", 60)?;
    system.access = authority.access(Some("own"));
    system.start_learner(LIMIT).await?;
    authority.issue("server", -60)?;
    ensure!(system.status().await.is_err(), "a client accepted an expired certificate");

    let mut actor = system.start_actor_with(&authority.access(Some("client")), |_| {})?;
    actor.until_log_holds("no connection to the learner", LIMIT).await?;
    authority.issue("server", 60)?;
    // Now the actor's certificate has expired.
    actor.until_log_holds("CertificateExpired", LIMIT).await?;
    authority.issue("client", 60)?;
    actor.until_log_holds("joined the learner", LIMIT).await
}
