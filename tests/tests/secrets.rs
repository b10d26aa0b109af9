//! No log line holds a secret, at any log level.

use std::fs;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use comic_tests::certificates::Authority;
use comic_tests::system::{SMALL, System};

const LIMIT: Duration = Duration::from_secs(120);
const TOKEN: &str = "a-token-that-no-log-may-hold";

#[tokio::test]
async fn neither_tokens_nor_keys_are_logged() -> Result<()> {
    let authority = Authority::new()?;
    authority.issue("server", 60)?;
    authority.issue("client", 60)?;
    let token = authority.path("token");
    fs::write(&token, TOKEN)?;
    let mut options = [authority.serving(), authority.asking()].concat();
    options.extend(["--token-file".to_owned(), token.display().to_string()]);
    let options: Vec<&str> = SMALL.into_iter().chain(options.iter().map(String::as_str)).collect();
    let mut system = System::new(&options)?;
    system.access = authority.access(Some("client"));
    system.access.token_file = Some(token);
    system.log_level = Some("trace".into());
    system.start_learner(LIMIT).await?;
    let access = system.access.clone();
    let mut actor = system.start_actor_with(&access, |command| {
        command.env("RUST_LOG", "trace");
    })?;
    actor.until_log_holds("joined the learner", LIMIT).await?;

    let mut secrets = vec![TOKEN.to_owned()];
    for key in ["server-key.pem", "client-key.pem"] {
        let pem = fs::read_to_string(authority.path(key))?;
        secrets.extend(pem.lines().filter(|line| !line.starts_with("---")).map(str::to_owned));
    }
    let learner = system.learner.as_ref().context("no learner")?;
    for (who, log) in [("learner", learner.log()), ("actor", actor.log())] {
        ensure!(log.contains("TRACE"), "the {who} did not log at the level TRACE");
        let found: Vec<_> = secrets.iter().filter(|secret| log.contains(secret.as_str())).collect();
        ensure!(found.is_empty(), "the {who} logs {found:?}");
    }
    Ok(())
}
