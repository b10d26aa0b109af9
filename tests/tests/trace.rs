//! The logs show the way of one unroll, from the actor that makes it to the update that trains on it.

use anyhow::{Context as _, Result, ensure};
use comic_tests::process::Process;
use comic_tests::steps::{LIMIT, leaves, the_accounting_balances_at_the_end, trains_on};
use comic_tests::system::{SMALL, System};
use serde_json::Value;

#[tokio::test]
async fn the_logs_show_the_way_of_one_unroll_from_its_actor_to_the_gradient() -> Result<()> {
    let mut system = System::new(&[&SMALL[..], &["--log-format", "json"]].concat())?;
    system.log_level = Some("info,comic_learner=trace".into());
    system.start_learner(LIMIT).await?;
    let access = system.access.clone();
    let actor = system.start_actor_with(&access, |command| {
        command.args(["--log-format", "json"]).env("RUST_LOG", "info,comic_actor=debug");
    })?;
    trains_on(&mut system, "the actor's unrolls are trained on").await?;

    let learner = system.learner.as_ref().context("no learner")?;
    let trained = lines(learner).find(|line| said(line) == "trained on").context("nothing was trained on")?;
    ensure!(trained["span"]["name"] == "update", "the learner does not log the update: {trained}");
    let name = ["incarnation", "sequence"].map(|part| trained["fields"][part].clone());
    let sequence = &name[1];
    for step in ["made", "sent", "acknowledged", "close"] {
        let of = |line: &Value| line["span"]["name"] == "unroll" && is(&line["span"], &name);
        let found = lines(&actor).find(|line| said(line) == step && of(line));
        let line = found.with_context(|| format!("the actor does not log that {sequence} was {step}"))?;
        ensure!(
            step != "sent" || line["fields"]["actor"] == trained["fields"]["actor"],
            "sent by another actor: {line}"
        );
        ensure!(step != "close" || takes(&line, "time.idle"), "the actor does not log how long it waited: {line}");
    }
    let acted = lines(&actor).any(|line| line["span"]["name"] == "rollout" && takes(&line, "time.busy"));
    ensure!(acted, "the actor does not log how long it takes to make unrolls");
    for step in ["validate", "insert"] {
        let found = lines(learner).any(|line| {
            let unroll = line["spans"].as_array().and_then(|spans| spans.iter().find(|span| span["name"] == "unroll"));
            line["span"]["name"] == step && unroll.is_some_and(|unroll| is(unroll, &name)) && takes(&line, "time.busy")
        });
        ensure!(found, "the learner does not log how long it took to {step} {sequence}");
    }
    leaves(actor).await?;
    the_accounting_balances_at_the_end(system).await
}

/// The complete lines of a log. The last line may be half written.
fn lines(process: &Process) -> impl Iterator<Item = Value> {
    let log = process.log();
    log.lines().filter_map(|line| serde_json::from_str(line).ok()).collect::<Vec<_>>().into_iter()
}

fn said(line: &Value) -> &str {
    line["fields"]["message"].as_str().unwrap_or_default()
}

fn is(found: &Value, name: &[Value; 2]) -> bool {
    ["incarnation", "sequence"].iter().zip(name).all(|(part, value)| found[*part] == *value)
}

fn takes(line: &Value, time: &str) -> bool {
    line["fields"][time].is_string()
}
