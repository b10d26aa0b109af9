//! When the learner requires client certificates, an actor without one tries for three minutes, or for `--give-up-after` if
//! that is shorter, and ends with exit code 2. The same holds for an actor that does not trust the learner's certificate. An
//! actor with one joins, and the learner trains on its unrolls.

use anyhow::{Result, ensure};
use comic_tests::certificates::Authority;
use comic_tests::steps::{LIMIT, leaves, the_accounting_balances_at_the_end, trains_on};
use comic_tests::system::{SMALL, System};

#[tokio::test]
async fn an_actor_without_an_accepted_certificate_ends_and_one_with_it_joins() -> Result<()> {
    let (own, foreign) = (Authority::new()?, Authority::new()?);
    own.issue("server", 60)?;
    own.issue("client", 60)?;
    foreign.issue("client", 60)?;
    let options = [own.serving(), own.asking()].concat();
    let options: Vec<&str> = SMALL.into_iter().chain(options.iter().map(String::as_str)).collect();
    let mut system = System::new(&options)?;
    system.access = own.access(Some("client"));
    system.start_learner(LIMIT).await?;

    let mut others = foreign.access(Some("client"));
    others.ca = own.access(None).ca;
    let distrustful = foreign.access(None);
    for access in [own.access(None), others, distrustful] {
        let mut refused = system.start_actor_with(&access, |actor| {
            actor.args(["--give-up-after", "1"]);
        })?;
        let status = refused.until_it_ends(LIMIT).await?;
        ensure!(status.code() == Some(2), "{access:?}: {status}: {}", refused.log());
    }
    let mut actor = system.start_actor()?;
    actor.until_log_holds("joined the learner", LIMIT).await?;
    trains_on(&mut system, "unrolls come in by the client's certificate").await?;
    leaves(actor).await?;
    the_accounting_balances_at_the_end(system).await
}
