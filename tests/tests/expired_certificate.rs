//! An expired certificate refuses actors only until it is renewed; then the learner trains on their unrolls. Neither the learner
//! nor the actor restarts.

use anyhow::{Result, ensure};
use comic_tests::certificates::Authority;
use comic_tests::steps::{LIMIT, leaves, the_accounting_balances_at_the_end, trains_on};
use comic_tests::system::{SMALL, System};

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
    actor.until_log_holds("joined the learner", LIMIT).await?;
    trains_on(&mut system, "unrolls come in by the renewed certificates").await?;
    leaves(actor).await?;
    the_accounting_balances_at_the_end(system).await
}
