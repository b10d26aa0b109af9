//! `comic-learner status` and `comic-learner health` against a learner with TLS and tokens, and its metrics over HTTP.

use std::fs;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use comic_tests::certificates::Authority;
use comic_tests::system::{SMALL, System};
use serde_json::Value;

const LIMIT: Duration = Duration::from_secs(120);

#[tokio::test]
async fn status_and_health_describe_a_running_learner() -> Result<()> {
    let authority = Authority::new()?;
    authority.issue("server", 60)?;
    let token = authority.path("token");
    fs::write(&token, "open-sesame")?;
    let mut options = authority.serving();
    options.extend(["--token-file".into(), token.display().to_string(), "--metrics-port".into(), "0".into()]);
    let options: Vec<&str> = SMALL.into_iter().chain(options.iter().map(String::as_str)).collect();
    let mut system = System::new(&options)?;
    system.access = authority.access(None);
    system.access.token_file = Some(token);
    system.start_learner(LIMIT).await?;
    let _actor = system.start_actor()?;
    system
        .until("an update", LIMIT, |status| {
            let metrics: Value = serde_json::from_str(&status.metrics_json).ok()?;
            (metrics["updates"].as_u64() > Some(0)).then_some(())
        })
        .await?;

    let answer = system.ask(&["status", "--json"])?;
    let status: Value =
        serde_json::from_slice(&answer.stdout).context(String::from_utf8_lossy(&answer.stderr).into_owned())?;
    ensure!(status["actors"]["alive"] == 1 && status["queue"]["capacity"].as_u64() > Some(0), "{status}");
    ensure!(status["accounting"]["trained"].as_u64() > Some(0), "{status}");
    ensure!(status["metrics"]["updates"].as_u64() > Some(0), "{status}");
    let answer = system.ask(&["status"])?;
    let text = String::from_utf8_lossy(&answer.stdout);
    for word in ["run ", "updates/s", "environment steps/s", "queue ", "ages ", "accounting ", "1 alive"] {
        ensure!(text.contains(word), "no `{word}` in {text}");
    }
    ensure!(system.ask(&["health"])?.status.code() == Some(0), "health must succeed while the learner serves");
    let page = system.metrics_page()?;
    ensure!(
        page.contains("comic_actors{state=\"alive\"} 1\n") && page.contains("comic_update_seconds_count"),
        "{page}"
    );

    let token = system.access.token_file.take();
    ensure!(system.ask(&["health"])?.status.code() == Some(0), "health must need no token");
    ensure!(
        system.ask(&["status"])?.status.code() == Some(2),
        "status without a token must end with 2: a retry would not help"
    );
    system.access.token_file = token;
    system.learner.take().context("no learner")?.kill()?;
    ensure!(system.ask(&["health"])?.status.code() == Some(1), "health must fail when no learner serves");
    ensure!(
        system.ask(&["status"])?.status.code() == Some(1),
        "status must end with 1 when no learner serves: a retry may help"
    );
    Ok(())
}

#[tokio::test]
async fn status_watch_follows_a_run_and_waits_for_an_absent_learner() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    let mut watching = system.start("comic-learner", &["status", "--watch"])?;
    watching.until_log_holds(&system.address(), LIMIT).await?;
    ensure!(!watching.log().contains("accounting "), "no learner serves yet: {}", watching.log());
    system.start_learner(LIMIT).await?;
    let _actor = system.start_actor()?;
    // In a file, one status follows the other.
    watching
        .until_log("two states, and the actor in one of them", LIMIT, |log| {
            log.matches("accounting ").count() >= 2 && log.contains("1 alive")
        })
        .await
}

#[tokio::test]
async fn the_metrics_say_that_the_trainer_moves_while_it_waits() -> Result<()> {
    let mut system = System::new(&[&SMALL[..], &["--metrics-port", "0"]].concat())?;
    system.start_learner(LIMIT).await?;
    // Without movement the silence would be as long as the learner's life.
    let silence = |system: &System| -> Option<u64> {
        let page = system.metrics_page().ok()?;
        page.lines().find_map(|line| line.strip_prefix("comic_trainer_silent_seconds ")?.parse().ok())
    };
    let what = "the trainer moved lately, although the learner started long ago";
    let deadline = tokio::time::Instant::now() + LIMIT;
    loop {
        let uptime = system.status().await?.uptime_seconds;
        if silence(&system).context("no silence")? + 3 < uptime as u64 {
            return Ok(());
        }
        ensure!(tokio::time::Instant::now() < deadline, "not within {LIMIT:?}: {what}");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}
